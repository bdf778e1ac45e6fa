"""Rewriting of OBJ materials (MTL) to the part that trimesh reads: names and simple statements.

Statements follow the specification of Wavefront, http://paulbourke.net/dataformats/mtl/
"""

from __future__ import annotations

import re
from collections.abc import Iterator

PICTURE = "map_kd"
QUOTED = re.compile(r"""(["'])(.*?)\1""")
COMMENT = re.compile(r"(?:^|\s)#")  # other # belong to names
# Numbers or words that follow an option of a texture; of the options with a range, at most.
OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-bm": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1,
    "-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-texres": 1, "-type": 1, "-colorspace": 1,
}  # fmt: skip
MOVING = {"-o": 0.0, "-s": 1.0, "-t": 0.0}  # options that change UVs, and values without effect


def rewritten(text: str) -> Iterator[str]:
    """Yield the lines of an MTL; pictures are plain names. Raise ValueError for moved ones."""
    for line in text.replace("\\\n", " ").splitlines():
        key, _, rest = COMMENT.split(line)[0].strip().replace("\t", " ").partition(" ")
        if key.lower() == PICTURE:
            yield f"{PICTURE} {_picture(rest.strip())}"
        elif key:
            yield line.strip()


def _picture(statement: str) -> str:
    """Return the name of the picture of a statement without its options."""
    words = statement
    while words.startswith("-") and words.split()[0].lower() in OPTIONS:
        option, *rest = words.split()
        option = option.lower()
        count = 0
        while count < min(OPTIONS[option], len(rest) - 1) and (
            count == 0 and option not in MOVING or _is_number(rest[count])
        ):
            count += 1
        values = [float(word) for word in rest[:count] if option in MOVING]
        if any(value != MOVING[option] for value in values):
            raise ValueError(
                f"its texture is moved or scaled by {option}; apply that to the UVs, or import "
                "only the geometry with --geometry-only."
            )
        words = words.split(maxsplit=count + 1)[-1]
    quoted = QUOTED.match(words)
    return quoted[2] if quoted else words


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
