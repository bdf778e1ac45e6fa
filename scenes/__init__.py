"""Small Mitsuba scenes with assets of our own making (see ``make_assets.py``)."""

from __future__ import annotations

from pathlib import Path

from svu_mi.errors import OptionError

NAMES = ("planes", "spheres", "vase", "knot")
LIGHTS = ("studio", "overcast", "clear", "window")
FOLDER = Path(__file__).resolve().parent


def names() -> tuple[str, ...]:
    """Return the names of the scenes that need no files of the user's."""
    return NAMES


def path(name: str) -> Path:
    """Return the XML file of a scene.

    Parameters of every scene (``-D key=value``): ``light`` (one of ``LIGHTS``),
    ``resolution`` (pixels per side), ``spp``, ``max_depth``, and ``integrator``: a type that
    takes a ``max_depth``, such as ``path`` or ``prb``.

    Args:
        name: one of ``NAMES``, or ``object``: any mesh with textures, in ``-D object=FOLDER``,
            under any lat-long image, ``-D environment=FILE``, times ``environment_scale``.

    Raises:
        OptionError: an unknown name.
    """
    if name not in (*NAMES, "object"):
        raise OptionError(f"There is no scene {name!r}; use one of {', '.join(NAMES)} or object.")
    return FOLDER / name / f"{name}.xml"
