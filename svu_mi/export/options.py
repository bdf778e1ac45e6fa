"""What ``svu export`` writes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from svu_mi.output.upright import Axis
from svu_mi.settings import require, require_types

Format = Literal["exr", "png", "glb", "xml", "materialx"]
FORMATS: tuple[Format, ...] = get_args(Format)
NEEDS: dict[Format, Format] = {"xml": "exr", "materialx": "png"}
"""Formats that refer to textures in another, which is then written, too."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Which files are written, and how."""

    formats: tuple[Format, ...] = FORMATS
    """``exr``: linear masters; ``png``: sRGB base colour, grey maps and the packed ``orm``;
    ``glb``: one file with mesh and textures, and another with entropy as vertex colours; ``xml``:
    an object for Mitsuba scenes and a preview; ``materialx``: ``standard_surface`` and an OBJ."""

    bits: int = 8
    """Of PNG, per channel: 8 or 16. The textures inside a GLB always have 8."""

    half: bool = False
    """EXR in half instead of single precision."""

    gutter: int | None = None
    """Texels that charts are carried on over their borders; None fills everything between them,
    which no reduction of the textures (mip-mapping) can look beyond."""

    up: Axis | None = None
    """Axis of the world that points upwards; None is the asset's own, as its cameras have it. glTF
    has +Y up: a +Z-up world is turned in the GLB, and there alone."""

    def __post_init__(self) -> None:
        require_types(self)
        known = all(name in FORMATS for name in self.formats)
        require(self, known and bool(self.formats), "formats", f"of {', '.join(FORMATS)}")
        require(self, self.bits in (8, 16), "bits", "8 or 16")
        fits = self.gutter is None or (type(self.gutter) is int and self.gutter >= 0)
        require(self, fits, "gutter", "None or a whole number, at least 0")
        require(self, self.up in (None, *get_args(Axis)), "up", "None, y or z")

    @property
    def written(self) -> tuple[Format, ...]:
        """The formats, and those they need."""
        needed = {*self.formats, *(NEEDS[name] for name in self.formats if name in NEEDS)}
        return tuple(name for name in FORMATS if name in needed)
