"""The commands: one dataclass each, its fields are the options."""

from __future__ import annotations

import dataclasses
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from svu_mi import _llvm
from svu_mi.errors import OptionError, SvuEnvironmentError
from svu_mi.progress import Progress

if TYPE_CHECKING:
    from rich.console import Console

    from svu_mi.capture import Capture

VARIANTS = ("cuda_ad_rgb", "metal_ad_rgb", "llvm_ad_rgb")  # the first that this machine can run

MAX_THREADS = 1024
RESERVED = ("parallel", "optimize")  # arguments of mi.load_file itself

Defines = Annotated[
    tuple[str, ...],
    tyro.conf.arg(aliases=["-D"], metavar="KEY=VALUE", help="Scene parameter; can be repeated."),
    tyro.conf.UseAppendAction,
]
Known = Annotated[
    tuple[str, ...],
    tyro.conf.arg(metavar="NAME=VALUE | scene", help_behavior_hint="(can be repeated)"),
    tyro.conf.UseAppendAction,
]
Threads = Annotated[int, tyro.conf.arg(aliases=["-t"], help="CPU threads; 0 = all.")]
Verbose = Annotated[bool, tyro.conf.arg(aliases=["-v"], help="Log more; errors with traceback.")]
Variant = Annotated[str, tyro.conf.arg(aliases=["-m"], help="Mitsuba variant.")]
Output = Annotated[Path, tyro.conf.arg(aliases=["-o"], help="Folder for the results.")]
Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE.xml")]
Resolution = Annotated[tuple[int, ...], tyro.conf.arg(metavar="SIZE | WIDTH HEIGHT")]


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every command, with Mitsuba's letters."""

    variant: Variant = "auto"
    """Mitsuba variant; auto takes the first usable of cuda, metal and llvm _ad_rgb."""
    threads: Threads = 0
    verbose: Verbose = False

    def start(self) -> None:
        """Set the variant and the number of threads.

        Raises:
            SvuEnvironmentError: the variant does not exist or cannot run here.
            OptionError: a negative number of threads.
        """
        if self.threads < 0:
            raise OptionError(f"--threads must be 0 (all) or more, got {self.threads}.")
        if self.threads > MAX_THREADS:
            raise OptionError(f"--threads must be at most {MAX_THREADS}, got {self.threads}.")
        import drjit as dr
        import mitsuba as mi

        try:
            mi.set_variant(*(VARIANTS if self.variant == "auto" else (self.variant,)))
        except (ImportError, AttributeError, ValueError, RuntimeError) as error:
            _llvm.require()  # the likely cause, with its remedy
            raise SvuEnvironmentError(
                f"Variant '{self.variant}' is not available: {error}; this Mitsuba has "
                f"{', '.join(mi.variants())}."
            ) from error
        import svu_mi.plugins  # noqa: F401 - registers them for the variant

        if self.threads:
            # One thread means one worker: without any, Mitsuba's scene loader waits for ever.
            dr.set_thread_count(max(self.threads, 2))
        mi.set_log_level(mi.LogLevel.Info if self.verbose else mi.LogLevel.Error)


@dataclass(frozen=True, kw_only=True)
class Entropy(Common):
    """Compute how much photographs say about every texel.

    Writes entropy.exr (1 = nothing known), coverage.exr (number of views), overview.png and
    run.json.
    """

    scene: Scene
    """Mitsuba scene with one sensor per photograph, or a capture folder."""
    images: Path | None = None
    """Folder with view_0000.exr, ...; without any photographs the scene itself is rendered."""
    output: Output = Path("out")
    define: Defines = ()
    shape: str | None = None
    """Id of the object, if the scene has several."""
    resolution: Resolution = (512,)
    """Texels per side, or width and height."""
    method: Literal["angular", "spectrum"] = "angular"
    """angular compares radiance by statistics of all views; spectrum, power spectra (the paper)."""
    preset: Literal["default", "calibrated", "fast", "paper"] = "default"
    known: Known = ()
    """Parameters that are not in question, such as metallic=0: they leave the grid. "scene" stands
    for those that the scene's own material does not vary."""
    skip: bool = True
    """Leave out work that changes nothing (unseen texels, blind views, equal channels, ...)."""
    unwrap: bool = False
    """Lay out new UVs even if the mesh has some."""
    spp: int = 64
    """Samples per pixel, when the scene is rendered."""

    def run(self, console: Console) -> int:
        """Run the pipeline and write the four files."""
        from svu_mi.options import NOTHING, Skip
        from svu_mi.output import prepare_folder, write_outputs
        from svu_mi.pipeline import estimate
        from svu_mi.surface import texels

        size = pair(self.resolution, "--resolution")
        defines, known = parse_defines(self.define), parse_known(self.known)
        prepare_folder(self.output)
        self.start()
        progress = Progress(console)
        capture = self._capture(progress, defines)
        with progress.stage("Laying out texels"):
            grid = texels(capture.mesh, size)
        result = estimate(
            capture, grid, self.method, self.preset, known=known,
            skip=Skip() if self.skip else NOTHING, progress=progress,
        )  # fmt: skip
        with progress.stage("Writing the results"):
            write_outputs(
                capture, result, self.output, settings=_settings(self), kernels=progress.kernels
            )
        console.print(f"Wrote {self.output}", markup=False, highlight=False, soft_wrap=True)
        return 0

    def _capture(self, progress: Progress, defines: dict[str, str]) -> Capture:
        from svu_mi.capture import has_photographs, load_capture, photographs_of, render_capture

        live = self.images is None and self.scene.suffix.lower() == ".xml"
        if live and not has_photographs(photographs_of(self.scene)):
            folder = self.output / "capture"
            with progress.stage("Rendering photographs") as stage:
                capture = render_capture(
                    self.scene, self.spp, folder=folder, shape=self.shape, defines=defines,
                    unwrap=self.unwrap, progress=stage.update,
                )  # fmt: skip
            warnings.warn(
                f"No photographs beside {self.scene} and no --images: the scene is rendered "
                f"into {folder} instead.",
                stacklevel=1,
            )
            return capture
        with progress.stage("Loading the capture"):
            return load_capture(
                self.scene, self.images, shape=self.shape, defines=defines, unwrap=self.unwrap
            )


@dataclass(frozen=True, kw_only=True)
class Render(Common):
    """Render every sensor of a scene into a capture folder.

    Unlike the mitsuba program, this one knows the plugins of svu_mi.
    """

    scene: Scene
    """Mitsuba scene."""
    output: Output = Path("capture")
    define: Defines = ()
    shape: str | None = None
    """Id of the object, if the scene has several."""
    spp: int = 64
    """Samples per pixel."""
    seed: int = 0
    views: int | None = None
    """Place this many sensors on a sphere around the object instead of the scene's own."""
    resolution: Resolution = (512,)
    """Film of those sensors: pixels per side, or width and height."""

    def run(self, console: Console) -> int:
        """Render the views."""
        from svu_mi.capture import render_capture

        self.start()
        with Progress(console).stage("Rendering photographs") as stage:
            capture = render_capture(
                self.scene, self.spp, self.seed, folder=self.output, shape=self.shape,
                views=self.views, resolution=pair(self.resolution, "--resolution"),
                defines=parse_defines(self.define), progress=stage.update,
            )  # fmt: skip
        console.print(
            f"Wrote {capture.count} photographs to {self.output}",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip
        return 0


@dataclass(frozen=True, kw_only=True)
class Demo(Common):
    """Render the vase that comes with svu_mi and compute its entropy."""

    output: Output = Path("out/demo")
    light: Literal["studio", "overcast", "clear", "window"] = "window"
    spp: int = 32
    """Samples per pixel of the photographs."""
    resolution: Resolution = (256,)
    """Texels per side, or width and height."""

    def run(self, console: Console) -> int:
        """Run ``entropy`` on the vase."""
        from svu_mi import scenes

        with tempfile.TemporaryDirectory(prefix="svu-demo-") as folder:
            common = {f.name: getattr(self, f.name) for f in dataclasses.fields(Common)}
            define = (f"light={self.light}",)
            status = Render(
                scene=scenes.path("vase"), output=Path(folder), define=define, spp=self.spp,
                **common,
            ).run(console)  # fmt: skip
            return status or Entropy(
                scene=Path(folder), output=self.output, resolution=self.resolution, **common
            ).run(console)


@dataclass(frozen=True, kw_only=True)
class Doctor(Common):
    """Say what is installed, what can run here, and what to do about the rest."""

    def run(self, console: Console) -> int:
        """Print the diagnosis."""
        from svu_mi.cli.doctor import doctor

        return doctor(console)


def pair(size: tuple[int, ...], option: str) -> tuple[int, int]:
    """Return (width, height) from one or two numbers.

    Raises:
        OptionError: another count of numbers, or one below 1.
    """
    if len(size) not in (1, 2) or min(size) < 1:
        raise OptionError(f"{option} takes one or two positive numbers, got {size}.")
    return size[0], size[-1]


def parse_defines(words: tuple[str, ...]) -> dict[str, str]:
    """Return ``-D`` words as a dictionary.

    Raises:
        OptionError: a word is not KEY=VALUE.
    """
    defines = {}
    for word in words:
        key, separator, value = word.partition("=")
        if not (key and separator):
            raise OptionError(f"-D takes KEY=VALUE, got {word!r}.")
        if key in RESERVED:
            raise OptionError(f"-D {word}: {key!r} cannot be the name of a scene parameter.")
        defines[key] = value
    return defines


def parse_known(words: tuple[str, ...]) -> dict[str, float] | Literal["scene"] | None:
    """Return ``--known`` words as values by parameter, or as ``"scene"``.

    Raises:
        OptionError: a word is not NAME=NUMBER, or "scene" among others.
    """
    if words == ("scene",):
        return "scene"
    known = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            known[name] = float(value)
        except ValueError:
            raise OptionError(
                f"--known takes NAME=NUMBER, such as metallic=0, or the single word scene; got "
                f"{word!r}."
            ) from None
    if len(known) < len(words):
        raise OptionError(f"--known names a parameter twice: {', '.join(words)}.")
    return known or None


def _settings(options: Any) -> dict[str, Any]:
    return {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
