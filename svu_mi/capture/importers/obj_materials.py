"""Rewriting of OBJ materials (MTL) to the part that trimesh reads: names and simple statements.

Statements follow the specification of Wavefront, http://paulbourke.net/dataformats/mtl/
"""

import re
from collections.abc import Iterator
from itertools import takewhile

PICTURE = "map_kd"
MOST = 1000  # textures; the name of each is searched in several folders
QUOTED = re.compile(r"""(["'])(.*?)\1""")
WORD = re.compile(r"\S+")
COMMENT = re.compile(r"(?:^|\s)#")  # other # belong to names
# Numbers or words that follow an option of a texture; of the options with a range, at most.
OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-bm": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1,
    "-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-texres": 1, "-type": 1, "-colorspace": 1,
}  # fmt: skip
MOVING = {"-o": 0.0, "-s": 1.0, "-t": 0.0}  # options that change UVs, and values without effect


def rewritten(text: str) -> Iterator[str]:
    """Yield the lines of an MTL; pictures are plain names.

    Moved pictures, or too many, raise ValueError.
    """
    pictures = 0
    for line in text.replace("\\\n", " ").splitlines():
        key, _, rest = COMMENT.split(line)[0].strip().replace("\t", " ").partition(" ")
        if key.lower() == PICTURE:
            pictures += 1
            if pictures > MOST:
                raise ValueError(f"its MTL has over {MOST} textures; export one material")
            yield f"{PICTURE} {_picture(rest.strip())}"
        elif key:
            yield line.strip()


def _picture(statement: str) -> str:
    """Return the name of the picture of a statement without its options."""
    words = list(WORD.finditer(statement))
    first, last = 0, len(words) - 1
    while first < last and (option := words[first][0].lower()) in OPTIONS:
        values = [word[0] for word in words[first + 1 : min(first + 1 + OPTIONS[option], last)]]
        leading = 0 if option in MOVING else len(values[:1])
        numbers = list(takewhile(_is_number, values[leading:]))
        if option in MOVING and any(float(number) != MOVING[option] for number in numbers):
            raise ValueError(
                f"its texture is moved or scaled by {option}; apply that to the UVs, or import "
                "only the geometry with --geometry-only."
            )
        first += 1 + leading + len(numbers)
    name = statement[words[first].start() :] if words else ""
    quoted = QUOTED.match(name)
    return quoted[2] if quoted else name


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
