"""XML that Mitsuba's parser would not survive: nested without end, or included from a pipe."""

from __future__ import annotations

from os.path import exists, isfile  # unlike Path's, they raise nothing for long names
from pathlib import Path
from xml.parsers import expat

import mitsuba as mi

from svu_mi.errors import SceneError, excerpt

DEEPEST = 500  # elements in one another; the parser calls itself for each, and 10 000 are too many
LONGEST = 300  # letters of a path, in messages


def check_nesting(path: Path) -> None:
    """Look through a scene's XML, and what it includes, before Mitsuba parses it.

    What is not XML is left to Mitsuba, and so are included names with ``$parameters``.

    Args:
        path: the XML file; files are found as ``mi.file_resolver()`` does.

    Raises:
        SceneError: elements are nested too deeply, or what it includes is a folder or a pipe.
    """
    waiting, seen = [path], set()
    while waiting:
        file = waiting.pop()
        if file in seen or not exists(file):
            continue
        if not isfile(file):  # reading a pipe would wait for ever
            raise SceneError(
                f"{path}: includes {excerpt(file, LONGEST)}, which is no file; name a file."
            )
        seen.add(file)
        for name in _named(file):
            beside, other = file.parent / name, Path(str(mi.file_resolver().resolve(name)))
            waiting.append(beside if exists(beside) else other)


def _named(path: Path) -> list[str]:
    """Return the files that an XML file names in its tags.

    Raises:
        SceneError: elements are nested too deeply.
    """
    names: list[str] = []
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise SceneError(
                f"{excerpt(path, LONGEST)}: more than {DEEPEST} elements are nested in one another "
                f"at line {parser.CurrentLineNumber}; close them before."
            )
        del tag  # <include> or <spectrum>, which Mitsuba reads while it parses
        name = attributes.get("filename")
        if name and "$" not in name:
            names.append(name)

    def end(tag: str) -> None:
        del tag
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        with path.open("rb") as stream:
            parser.ParseFile(stream)
    except (expat.ExpatError, OSError):
        pass  # Mitsuba says what is wrong, and where
    return names
