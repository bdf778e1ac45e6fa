"""Small Mitsuba scenes with assets of our own making (see ``make_assets.py``)."""

from __future__ import annotations

import shutil
from contextlib import ExitStack
from pathlib import Path

from svu_mi.core.io.files import prepare_folder, replacing
from svu_mi.errors import OptionError, OutputError

ABOUT = {
    "planes": "two upright squares of copper, one matt, one glossy, seen from the front",
    "spheres": "eight spheres, from glossy to matt, four of plastic and four of metal",
    "vase": "unglazed clay, a glaze, painted bands and a golden rim, open at the top",
    "knot": "a tube that hides parts of itself: ribbons of brass, lacquer and rubber",
    "object": "any textured mesh of yours, under any environment map",
}
NAMES = tuple(name for name in ABOUT if name != "object")
LIGHTS = ("studio", "overcast", "clear", "window")
FOLDER = Path(__file__).resolve().parent
ASSETS = (".xml", ".ply", ".exr")


def names() -> tuple[str, ...]:
    """Return the names of the scenes that need no files of the user's."""
    return NAMES


def path(name: str) -> Path:
    """Return the XML file of a scene.

    Parameters of every scene (``-D key=value``): ``light`` (one of ``LIGHTS``),
    ``resolution`` (pixels per side), ``spp``, ``max_depth``, and ``integrator``: a type that
    takes a ``max_depth``, such as ``path`` or ``prb``.
    """
    if name not in (*NAMES, "object"):
        raise OptionError(f"There is no scene {name!r}; use one of {', '.join(NAMES)} or object.")
    return FOLDER / name / f"{name}.xml"


def copy(name: str, folder: str | Path) -> Path:
    """Copy a scene with its assets and lights, so that it loads from there.

    Files that are there already and are the same are left; the folder may hold other scenes.

    Returns:
        The XML file of the copy.
    """
    scene, folder = path(name), Path(folder)
    places = [scene.parent] if name == "object" else [scene.parent, FOLDER / "lights"]
    files = [file for place in places for file in place.iterdir() if file.suffix in ASSETS]
    copies = {folder / file.relative_to(FOLDER): file for file in sorted(files)}
    missing = {target: file for target, file in copies.items() if not target.exists()}
    for target, file in copies.items():
        if target not in missing and (target.is_dir() or target.read_bytes() != file.read_bytes()):
            raise OutputError(f"{target}: is there and differs; choose another folder.")
    with ExitStack() as together:  # all files, or none if the disk is full
        for target, file in missing.items():
            prepare_folder(target.parent)
            shutil.copyfile(file, together.enter_context(replacing(target)))
    return folder / scene.relative_to(FOLDER)
