"""Example scenes for Mitsuba, with procedural assets (``make_assets.py``)."""

from __future__ import annotations

import shutil
from contextlib import ExitStack
from pathlib import Path

from svu_mi.core.io.files import prepare_folder, replacing
from svu_mi.errors import OptionError, OutputError

ABOUT = {
    "planes": "two upright copper squares, one matte and one glossy, seen from the front",
    "spheres": "eight spheres from glossy to matte, four plastic and four metal",
    "vase": "a vase of clay with glaze, painted bands and golden rim, open at the top",
    "knot": "a knotted tube with self-occlusion: ribbons of brass, lacquer and rubber",
    "object": "any textured mesh under any environment map (your files)",
}
NAMES = tuple(name for name in ABOUT if name != "object")
LIGHTS = ("studio", "overcast", "clear", "window")
FOLDER = Path(__file__).resolve().parent
ASSETS = (".xml", ".ply", ".exr")


def names() -> tuple[str, ...]:
    """Return the names of the scenes that need no files from the user."""
    return NAMES


def path(name: str) -> Path:
    """Return the path of a scene's XML file.

    Scene parameters (``-D key=value``): ``light`` (one of ``LIGHTS``), ``resolution`` (pixels per
    side), ``spp`` (samples per pixel), ``max_depth`` (maximum path length) and ``integrator``. The
    integrator can be ``path``, ``prb``, or another type with a ``max_depth``.
    """
    if name not in (*NAMES, "object"):
        raise OptionError(f"Unknown scene {name!r}; use one of {', '.join(NAMES)} or object.")
    return FOLDER / name / f"{name}.xml"


def copy(name: str, folder: str | Path) -> Path:
    """Copy a scene with its assets and lights; return the path of its XML file.

    The folder may contain other scenes. Identical files are kept; an existing file with other
    contents raises an ``OutputError``.
    """
    scene, folder = path(name), Path(folder)
    places = [scene.parent] if name == "object" else [scene.parent, FOLDER / "lights"]
    files = [file for place in places for file in place.iterdir() if file.suffix in ASSETS]
    copies = {folder / file.relative_to(FOLDER): file for file in sorted(files)}
    missing = {target: file for target, file in copies.items() if not target.exists()}
    for target, file in copies.items():
        if target not in missing and (target.is_dir() or target.read_bytes() != file.read_bytes()):
            raise OutputError(f"{target}: exists with other contents; choose another folder.")
    with ExitStack() as together:  # writes all files, or none if the disk is full
        for target, file in missing.items():
            prepare_folder(target.parent)
            shutil.copyfile(file, together.enter_context(replacing(target)))
    return folder / scene.relative_to(FOLDER)
