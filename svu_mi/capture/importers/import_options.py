"""Import options: environment map, overrides of missing or wrong metadata.

The command line reads this before Mitsuba is loaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from svu_mi.errors import OptionError

Up = Literal["y", "z"]

# Rotations from the frame of Mitsuba's envmap (+Y top row, +Z centre, +X at u = 1/4) to the world,
# by the convention that a map was made in.
ENVIRONMENT_AXES = {
    "mitsuba": np.eye(3),
    "opengl": np.diag([-1.0, 1.0, -1.0]),  # +Y top, -Z centre, -X at u = 1/4
    "threejs": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),  # +Y top, +X centre
    "blender": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),  # +Z top, +X centre, +Y at u = 1/4
}


@dataclass(frozen=True, kw_only=True)
class Light:
    """An environment map.

    Attributes:
        path: an HDR or EXR lat-long map, whose rows are those of pixels: the first is half a row
            away from the pole, unless it was made for Mitsuba (text becomes a path).
        to_world: (3, 3) float64, from the frame of Mitsuba's envmap to the world: a rotation,
            such as one of ``ENVIRONMENT_AXES``.
        scale: factor of its radiance.
    """

    path: Path
    to_world: np.ndarray = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Overrides of missing or wrong metadata."""

    mesh: str | Path | None = None
    """The object: GLB, glTF, OBJ, PLY or STL; by default the mesh that the source names."""
    mesh_up: Up | None = None
    """Axis that is up in the mesh's file (glTF: y), if it is not that of the poses."""
    world_up: Up | None = None
    """Axis that is up in the world of the poses (Blender, nerfstudio: z); needs --mesh-up."""
    mesh_scale: float = 1.0
    """Units of the poses per unit of the mesh: 0.001 for a mesh in mm and poses in m."""
    geometry_only: bool = False
    """Ignore UVs and textures of the mesh, and lay out new UVs."""
    environment: Light | None = None
    """The light; by default the one that the source names."""
    exposures: str | Path | None = None
    """Gains of the photographs: a file with lines NAME GAIN, or exif; by default those of the
    source."""
    response: str | Path | None = None
    """What codes of PNG and JPEG mean, measured: a file with lines ENCODED LINEAR, or ENCODED R G
    B; by default sRGB, or what the source says. EXR, HDR and PFM are linear."""
    shrink: float = 1.0
    """Shrink photographs by this factor."""
    every: int = 1
    """Take every N-th photograph."""
    missing: Literal["refuse", "leave-out"] = "refuse"
    """What to do if poses have no photograph: leave-out goes on with the others."""
    fixes: Sequence[str] = ()
    """Correction that svu check proposed; can be repeated."""

    def __post_init__(self) -> None:
        """Refuse numbers out of range, and one axis without the other (OptionError)."""
        if self.every < 1:
            raise OptionError(f"--every must be 1 (all photographs) or more, got {self.every}.")
        if self.missing not in ("refuse", "leave-out"):
            raise OptionError(f"--missing must be refuse or leave-out, got {self.missing!r}.")
        if not 0 < self.mesh_scale < np.inf:
            raise OptionError(f"--mesh-scale must be positive, got {self.mesh_scale}.")
        if (self.mesh_up is None) != (self.world_up is None):
            raise OptionError("--mesh-up and --world-up need each other; give both.")
