"""``svu import``: captures of other tools as capture folders."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from svu_mi.cli.inputs import Common, Output, say
from svu_mi.progress import Progress
from svu_mi.results.writing import claimed

if TYPE_CHECKING:
    from svu_mi.formats.importing import ImportOptions

From = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
Gains = Annotated[str | None, tyro.conf.arg(metavar="FILE | exif")]
Fixes = Annotated[
    tuple[str, ...], tyro.conf.arg(metavar="NAME"), tyro.conf.UseAppendAction,
]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Import(Common):
    """Turn the capture of another tool into a capture folder.

    Reads transforms.json (NeRF, Blender, nerfstudio), COLMAP, Stanford-ORB and Objects with
    Lighting; writes scene.xml with the mesh and the light, linear EXR photographs with their
    masks, and capture.json. Look at the result with svu check.
    """

    source: From
    """The file or folder."""
    output: Output = Path("capture")
    format: Literal["auto", "transforms", "colmap", "stanford-orb", "owl"] = "auto"
    images: Path | None = None
    """COLMAP: folder of the photographs."""
    masks: Path | None = None
    """COLMAP: folder of the masks."""
    split: Literal["train", "test", "val"] = "train"
    """Part of the data set."""
    mesh: Path | None = None
    """The object: GLB, glTF, OBJ, PLY or STL."""
    mesh_up: Literal["y", "z"] | None = None
    """Axis that is up in the mesh's file (glTF: y)."""
    world_up: Literal["y", "z"] | None = None
    """Axis that is up in the world of the poses (Blender, nerfstudio: z)."""
    mesh_scale: float = 1.0
    """Units of the poses per unit of the mesh: 0.001 for a mesh in mm and poses in m."""
    geometry_only: bool = False
    """Leave UVs and textures of the mesh out, and lay out new UVs."""
    environment: Path | None = None
    """The light: a lat-long map, HDR or EXR."""
    environment_axes: Literal["mitsuba", "opengl", "threejs", "blender"] = "mitsuba"
    """Top and centre of the map: +Y +Z, +Y -Z, +Y +X, or +Z +X."""
    environment_scale: float = 1.0
    """Factor of the light's radiance."""
    exposures: Gains = None
    """Gains of the photographs: a file with lines NAME GAIN, or exif."""
    environment_view: str | None = None
    """Stanford-ORB: test photograph whose environment is the light; by default the first."""
    original_world: bool = False
    """Undo the applied_transform of nerfstudio."""
    undistort: bool = False
    """COLMAP: straighten the photographs first (needs pycolmap)."""
    shrink: float = 1.0
    """Make photographs smaller by this factor."""
    every: int = 1
    """Take every N-th photograph."""
    fix: Fixes = ()
    """Correction that svu check has proposed; can be repeated."""

    def run(self, console: Console) -> int:
        """Import the capture and say what was found."""

        with claimed(self.output, "svu import", tidy=True):
            self.start()
            notes = self._import(Progress(console))
        for note in notes:
            say(console, note)
        say(console, f"Wrote {self.output}; look at it with: svu check {self.output}")
        return 0

    def _import(self, progress: Progress) -> list[str]:
        from svu_mi.formats.colmap.undistortion import undistort
        from svu_mi.formats.importing import import_capture
        from svu_mi.formats.reading import ReadOptions, read_source

        kind = None if self.format == "auto" else self.format
        reading = ReadOptions(
            format=kind, images=self.images, masks=self.masks, split=self.split,
            environment_view=self.environment_view, original_world=self.original_world,
        )  # fmt: skip
        with tempfile.TemporaryDirectory(prefix="svu-undistorted-") as scratch:
            path = self.source
            if self.undistort:
                with progress.stage("Undistorting photographs"):
                    path = undistort(
                        path, Path(scratch) / "project", images=self.images, masks=self.masks
                    )
                reading = replace(reading, format="colmap", images=None, masks=None)
            with progress.stage("Reading poses"):
                source = read_source(path, reading)
                if self.undistort:
                    source = replace(source, root=self.source)
            with progress.stage("Converting photographs") as stage:
                return import_capture(source, self.output, self._options(), progress=stage.update)

    def _options(self) -> ImportOptions:
        from svu_mi.formats.importing import ImportOptions
        from svu_mi.formats.source import ENVIRONMENT_AXES, Light

        light = None
        if self.environment is not None:
            axes = ENVIRONMENT_AXES[self.environment_axes]
            light = Light(path=self.environment, to_world=axes, scale=self.environment_scale)
        exposures: Path | Literal["exif"] | None = None
        if self.exposures is not None:
            exposures = "exif" if self.exposures == "exif" else Path(self.exposures)
        return ImportOptions(
            exposures=exposures,
            mesh=self.mesh, mesh_up=self.mesh_up, world_up=self.world_up,
            mesh_scale=self.mesh_scale, geometry_only=self.geometry_only, environment=light,
            shrink=self.shrink, every=self.every, fixes=self.fix,
        )  # fmt: skip
