"""``svu import``: conversion of captures of other tools to capture folders."""

import shlex
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from tyro.conf import Positional, arg

from svu_mi.capture.importers.import_options import ENVIRONMENT_AXES, ImportOptions, Light
from svu_mi.capture.importers.registry import ReadOptions, read_source
from svu_mi.cli.base_command import BaseCommand
from svu_mi.cli.loading import require_memory
from svu_mi.cli.parse_options import parse_options
from svu_mi.cli.shared_options import Count, MapOptions, Number, Output, Overwrite
from svu_mi.cli.streams import print_line
from svu_mi.core.io.output_folder import Claim, claimed
from svu_mi.core.memory import Need
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError

if TYPE_CHECKING:
    from svu_mi.capture.capture import Capture
    from svu_mi.capture.importers.import_capture import Imported

From = Annotated[Path, Positional, arg(metavar="SOURCE")]
Gains = Annotated[str | Path | None, arg(metavar="FILE | exif | none | estimate")]
Mesh = Annotated[str | Path | None, arg(metavar="FILE")]
Curve = Annotated[Path | None, arg(metavar="FILE")]
Place = Annotated[tuple[float, float, float] | None, arg(metavar="X Y Z")]
Color = Annotated[tuple[float, float, float], arg(metavar="R G B")]
Fixes = Annotated[tuple[str, ...], arg(name="fix", metavar="NAME"), tyro.conf.UseAppendAction]
CONVENTION = MapOptions()


def _light(environment: Path | None = None, convention: MapOptions = CONVENTION) -> Light | None:
    """Return the light given by command-line options.

    Args:
        environment: Environment map, a lat-long HDR or EXR file (default: the map of the source).
        convention: Its axes and unit.
    """
    return convention.light(environment)


@dataclass(frozen=True, kw_only=True)
class Conversion(ImportOptions):
    """Import options on the command line."""

    mesh: Mesh = None
    environment: Annotated[Light | None, arg(constructor=_light)] = None
    faces: Count = None
    table: Number = None
    flash: Place = None
    flash_intensity: Color = (1.0, 1.0, 1.0)
    exposures: Gains = None
    response: Curve = None
    fixes: Fixes = ()


@dataclass(frozen=True, kw_only=True)
class Import(BaseCommand):
    """Convert a capture of another tool to a capture folder.

    Reads transforms.json (NeRF, Blender, nerfstudio), COLMAP, Meshroom, poses_bounds.npy (LLFF),
    cameras_sphere.npz (IDR, NeuS), Stanford-ORB and Objects with Lighting. Writes scene.xml with
    mesh and light, linear EXR photographs with masks, and capture.json. Next: svu check.
    """

    uses_matplotlib = False
    first = "source output mesh mesh-up world-up mesh-scale environment images missing fix"
    source: From
    """File or folder to convert."""
    output: Output = Path("capture")
    overwrite: Overwrite = False
    undistort: bool = False
    """COLMAP: undistort the photographs with pycolmap, which supports more camera models, such as
    fisheye lenses."""
    reading: ReadOptions = ReadOptions()
    conversion: Conversion = Conversion()

    @property
    def words(self) -> list[str]:
        """Arguments of this command, without its output folder."""
        light = self.conversion.environment
        asked = {
            "undistort": self.undistort, **_changed_options(self.reading),
            **({} if light is None else _light_options(light)), **_changed_options(self.conversion),
        }  # fmt: skip
        return [str(self.source), *(word for pair in asked.items() for word in _arguments(*pair))]

    def changed(self, output: Path | None, **conversion: Any) -> str:
        """Return the command line of this import with other options of the conversion."""
        other = replace(self, conversion=replace(self.conversion, **conversion))
        return shlex.join(["svu", "import", *other.words, "-o", str(output)])

    def run(self, console: Console) -> int:
        """Import the capture, and print the notes about it."""
        from svu_mi.capture.importers.import_capture import NO_LIGHT

        with claimed(self.output, "import", overwrite=self.overwrite) as place:
            self.start()
            notes, scale = self._import(Progress(console), place)
        name = shlex.quote(str(self.output))
        for note in notes:
            print_line(console, note)
        if scale is not None:
            again = self.changed(self.output, mesh_scale=_rounded(scale))
            print_line(console, f"Wrote {self.output}; import it again with: {again}")
            return 0
        print_line(console, f"Wrote {self.output}; check it with: svu check {name}")
        if NO_LIGHT in notes:
            print_line(console, f"Then estimate its light with: svu light {name}")
        return 0

    def _import(self, progress: Progress, place: Claim) -> "Imported":
        from svu_mi.capture.importers.colmap.undistortion import read_undistorted
        from svu_mi.capture.importers.import_capture import plan_import

        path, reading = self.source, self.reading
        # In the draft, where the next import clears what a killed one has left.
        with tempfile.TemporaryDirectory(prefix=".svu-undistorted-", dir=place.draft) as scratch:
            if self.undistort:
                with progress.stage("Undistorting photographs"):
                    source = read_undistorted(path, Path(scratch), reading)
            else:
                with progress.stage("Reading poses"):
                    source = read_source(path, reading)
            with progress.stage("Converting photographs") as stage:
                plan = plan_import(source, self.conversion)
                require_memory(progress, str(self.source), Need("import", plan.sizes))
                return plan.write(place, self.words, stage.update)


def reimport_command(capture: "Capture", fixes: Sequence[str], mesh_scale: float = 1.0) -> str:
    """Return the command line that repeats the import of a capture with corrections.

    Args:
        capture: Capture that was imported.
        fixes: Names of additional corrections.
        mesh_scale: Factor by which the scale of the mesh is multiplied.
    """
    from svu_mi.capture import capture_folder

    record = None if capture.source is None else capture_folder.read(capture.source)
    given = _parse_arguments(record.imported.get("options") if record else None)
    if given is None:  # imported from Python or by an earlier version, or changed since
        unit = [] if mesh_scale == 1 else _arguments("mesh_scale", _rounded(mesh_scale))
        return " ".join(["svu import ...", *unit, *_arguments("fixes", _without_reverted(fixes))])
    every = _without_reverted((*given.conversion.fixes, *fixes))
    scale = _rounded(given.conversion.mesh_scale * mesh_scale)
    return given.changed(capture.source, fixes=every, mesh_scale=scale)


def _rounded(scale: float) -> float:
    return float(f"{scale:.6g}")


def _parse_arguments(words: Any) -> Import | None:
    """Return the recorded options of an import; None if invalid (the file is not trusted)."""
    is_text = isinstance(words, list) and all(isinstance(word, str) for word in words)
    if not is_text or not all(word.isprintable() and "=-" not in word for word in words):
        return None
    from svu_mi.capture.importers.axis_fixes import FIXES

    try:
        command, unknown = parse_options("import", Import, words)
    except OptionError:
        return None
    return None if unknown or set(command.conversion.fixes) - FIXES.keys() else command


def _without_reverted(fixes: Iterable[str]) -> tuple[str, ...]:
    """Return corrections without adjacent pairs that cancel each other."""
    import numpy as np

    from svu_mi.capture.importers.axis_fixes import FIXES

    kept: list[str] = []
    for name in fixes:
        matrix = FIXES[name].matrix if name in FIXES else None
        if kept[-1:] == [name] and (matrix is None or np.allclose(matrix @ matrix, np.eye(3))):
            kept.pop()
        else:
            kept.append(name)
    return tuple(kept)


def _changed_options(options: Any) -> dict[str, Any]:
    """Return the options that differ from their defaults, except the light."""
    known = (field for field in fields(options) if field.name != "environment")
    pairs = ((field.name, getattr(options, field.name), field.default) for field in known)
    return {name: value for name, value, default in pairs if value != default}


def _light_options(light: Light) -> dict[str, Any]:
    """Return the options of a light (see ``_light``)."""
    axes = [name for name, axes in ENVIRONMENT_AXES.items() if (axes == light.to_world).all()]
    return {
        "environment": light.path,
        **({} if axes == ["mitsuba"] else {"environment_axes": axes[0]}),
        **({} if light.scale == 1 else {"environment_scale": light.scale}),
    }


def _arguments(name: str, value: Any) -> list[str]:
    flag = {"fixes": "--fix"}.get(name, f"--{name.replace('_', '-')}")
    if isinstance(value, bool):
        return [flag] if value else []
    values = value if isinstance(value, tuple) else [value]
    return [word for one in values for word in (flag, str(one))]
