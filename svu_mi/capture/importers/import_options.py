"""Import options: environment map, overrides of missing or wrong metadata.

The command line reads this before Mitsuba is loaded.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from svu_mi.core.validation import require_types
from svu_mi.errors import OptionError

Up = Literal["y", "z"]

# Rotations from the frame of Mitsuba's envmap (+Y top row, +Z centre, +X at u = 1/4) to the world,
# by the convention of the map.
ENVIRONMENT_AXES = {
    "mitsuba": np.eye(3),
    "opengl": np.diag([-1.0, 1.0, -1.0]),  # +Y top, -Z centre, -X at u = 1/4
    "threejs": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),  # +Y top, +X centre
    "blender": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),  # +Z top, +X centre, +Y at u = 1/4
}


@dataclass(frozen=True, kw_only=True)
class Light:
    """Environment map of a capture.

    Attributes:
        path: path of an HDR or EXR lat-long map, also as text. Its first row is centred half a row
            below the pole, unless the map was made for Mitsuba.
        to_world: (3, 3) rotation from the frame of Mitsuba's envmap to the world, such as one of
            ``ENVIRONMENT_AXES``.
        scale: factor of the radiance.

    Example:
        >>> environment = svu.Light(path="scenes/lights/window.exr", scale=2.0)
        >>> environment.to_world.shape
        (3, 3)
    """

    path: Path
    to_world: np.ndarray = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0

    def __post_init__(self) -> None:
        if isinstance(self.path, str):
            object.__setattr__(self, "path", Path(self.path))
        require_types(self)


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Options of an import: mesh, light, and overrides of missing or wrong metadata.

    Example:
        >>> options = svu.ImportOptions(mesh="scan.obj", mesh_up="z", world_up="y", shrink=2)
        >>> options.every
        1
    """

    mesh: str | Path | None = None
    """Mesh file: GLB, glTF, OBJ, PLY or STL. Required, except for data sets that contain a mesh."""
    mesh_up: Up | None = None
    """Up axis in the mesh file, y (glTF) or z, if the poses have another one; needs --world-up."""
    world_up: Up | None = None
    """Up axis of the poses, y or z (Blender, nerfstudio); needs --mesh-up."""
    mesh_scale: float = 1.0
    """Units of the poses per unit of the mesh, above 0: 0.001 for a mesh in mm and poses in m."""
    geometry_only: bool = False
    """Compute new UVs, and ignore textures: for overlapping UVs, or several materials."""
    faces: int | None = None
    """Number of faces, at least 100, to which a mesh without UVs is simplified. Use it for scans of
    more than some 200 000 faces; at a fifth of the faces, roughness loses 1.3 to 1.6 dB. Default:
    all faces."""
    table: float | None = None
    """Height of a table above the lowest point of the object, in units of the poses; 0: the object
    stands on it. "Up" is ``world_up``, else that of the cameras. Default: no table."""
    table_albedo: float = 0.5
    """Reflectance of the table, in [0, 1]; 0 is a black table, which only hides light."""
    flash: tuple[float, float, float] | None = None
    """Place of a lamp that is fixed to the camera: left of, above and in front of the lens, in the
    unit of the poses. Default: no flash."""
    flash_intensity: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Radiant intensity of the flash, R, G and B, above 0: irradiance x distance^2 on a surface
    that faces it."""
    environment: Light | None = None
    """Environment map (default: the map of the source, else no light)."""
    exposures: str | Path | None = None
    """Exposure gains, positive factors of radiance: a text file with lines NAME GAIN; exif; none
    (all are equal); estimate (unknown: estimated with the light, or by --gains estimate). Default:
    gains of the source, else EXIF if all photographs have it, else none for EXR, HDR and PFM
    and estimate for other files."""
    response: str | Path | None = None
    """Measured response curve of PNG and JPEG, if not sRGB: a text file with lines ENCODED LINEAR
    or ENCODED R G B (default: the curve of the source, else sRGB)."""
    shrink: float = 1.0
    """Divisor of the width and height of photographs, at least 1. Increase it to save memory if
    pixels are smaller than texels."""
    every: int = 1
    """Import only every N-th photograph, N at least 1. Increase it for video frames."""
    missing: Literal["refuse", "leave-out"] = "refuse"
    """Poses without a photograph: refuse stops with an error, leave-out ignores them."""
    fixes: Sequence[str] = ()
    """Name of an axis correction that svu check has proposed, such as mesh-x90; can be repeated."""

    def __post_init__(self) -> None:
        """Raise OptionError for numbers out of range, and for one up axis without the other."""
        require_types(self)
        for name, is_valid, words in (
            ("every", self.every >= 1, "1 (all photographs) or more"),
            ("faces", self.faces is None or self.faces >= 100, "100 or more"),
            ("table", self.table is None or np.isfinite(self.table), "a finite number"),
            ("table_albedo", 0 <= self.table_albedo <= 1, "in [0, 1]"),
            ("flash", self.flash is None or np.isfinite(self.flash).all(), "three finite numbers"),
            ("flash_intensity", all(0 < x < np.inf for x in self.flash_intensity), "positive"),
            ("mesh_scale", 0 < self.mesh_scale < np.inf, "positive"),
        ):
            if not is_valid:
                given = getattr(self, name)
                raise OptionError(f"--{name.replace('_', '-')} must be {words}, got {given}.")
        if (self.mesh_up is None) != (self.world_up is None):
            raise OptionError("--mesh-up and --world-up need each other; give both.")
