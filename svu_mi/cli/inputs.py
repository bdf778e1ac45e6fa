"""What commands have in common: their options, and the way to the photographs."""

from __future__ import annotations

import dataclasses
import logging
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro
from rich.console import Console

from svu_mi import _llvm
from svu_mi.errors import OptionError, SvuEnvironmentError, printable
from svu_mi.limits import FEWEST_THREADS, require_spp, require_texels
from svu_mi.progress import Progress

if TYPE_CHECKING:
    from svu_mi.capture import Capture
    from svu_mi.capture.images import Missing
    from svu_mi.pipeline import Estimate
    from svu_mi.surface import Texels

log = logging.getLogger(__name__)

VARIANTS = ("cuda_ad_rgb", "metal_ad_rgb", "llvm_ad_rgb")  # the first that this machine can run

MAX_THREADS = 1024

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
Threads = Annotated[
    int,
    tyro.conf.arg(
        aliases=["-t"],
        help="CPU threads; 0 = all. At least 2: Mitsuba cannot read EXR files with one.",
    ),
]
Verbose = Annotated[bool, tyro.conf.arg(aliases=["-v"], help="Log more; errors with traceback.")]
Variant = Annotated[str, tyro.conf.arg(aliases=["-m"], help="Mitsuba variant.")]
Output = Annotated[Path, tyro.conf.arg(aliases=["-o"], help="Folder for the results.")]
Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE.xml")]
Resolution = Annotated[tuple[int, ...], tyro.conf.arg(metavar="SIZE | WIDTH HEIGHT")]


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every command, with Mitsuba's letters."""

    draws: ClassVar[bool] = True
    """Whether the command draws pictures, for which matplotlib is imported."""
    variant: Variant = "auto"
    """Mitsuba variant; auto takes the first usable of cuda, metal and llvm _ad_rgb."""
    threads: Threads = 0
    verbose: Verbose = False
    trust: bool = False
    """Let Mitsuba load libraries from a folder named plugins beside the scene, or in the working
    directory: they run with all your rights. Without it they are refused."""

    def start(self) -> None:
        """Set the variant and the number of threads.

        Raises:
            SvuEnvironmentError: the variant does not exist or cannot run here.
            OptionError: a negative number of threads.
            SceneError: the working directory has libraries that Mitsuba would load.
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
        from svu_mi.capture.trust import require_own_plugins

        require_own_plugins(self.trust)

        wanted = self.threads or dr.thread_count()
        if self.threads == 1:
            log.warning(f"--threads 1: {FEWEST_THREADS} are used, which Mitsuba needs to read EXR.")
        dr.set_thread_count(max(wanted, FEWEST_THREADS))
        mi.set_log_level(mi.LogLevel.Info if self.verbose else mi.LogLevel.Error)


@dataclass(frozen=True, kw_only=True)
class OfScene(Common):
    """Options of every command that reads a scene."""

    scene: Scene
    """Mitsuba scene with one sensor per photograph, or a capture folder."""
    output: Output = Path("out")
    define: Defines = ()
    shape: str | None = None
    """Id of the object, if the scene has several."""

    def defines(self) -> dict[str, str]:
        """Return the -D words as a dictionary.

        Raises:
            OptionError: a word is not KEY=VALUE.
        """
        pairs = [word.partition("=") for word in self.define]
        for word, (key, separator, _) in zip(self.define, pairs, strict=True):
            if not (key and separator):
                raise OptionError(f"-D takes KEY=VALUE, got {word!r}.")
        return {key: value for key, _, value in pairs}


@dataclass(frozen=True, kw_only=True)
class FromPhotographs(OfScene):
    """Options of every command that starts from photographs."""

    images: Path | None = None
    """Folder with view_0000.exr, ...; without any photographs the scene itself is rendered."""
    resolution: Resolution = (512,)
    """Texels per side, or width and height."""
    unwrap: bool = False
    """Lay out new UVs even if the mesh has some."""
    spp: int = 64
    """Samples per pixel, when the scene is rendered."""

    @property
    def rendered(self) -> Path:
        """Where a scene without photographs is rendered to."""
        return self.output / "capture"

    def check(self) -> None:
        """Refuse options that make no sense, before any work.

        Raises:
            OptionError: there is one.
        """
        require_texels(pair(self.resolution, "--resolution"), "--resolution")
        require_spp(self.spp, "--spp")
        self.defines()

    def load(
        self, progress: Progress, *, again: bool = False, missing: Missing = "refuse"
    ) -> tuple[Capture, Texels]:
        """Load the photographs, or render them, and lay out texels.

        Args:
            progress: shows what is going on.
            again: take photographs that an earlier run has rendered into the output folder.
            missing: what to do with sensors that have no photograph (see ``load_capture``).

        Raises:
            SceneError: the scene cannot be loaded or lacks something.
            CaptureError: photographs are missing, unreadable or do not fit.
            OptionError: the resolution is not a size.
        """
        from svu_mi.surface import texels

        size = pair(self.resolution, "--resolution")
        capture = self._capture(progress, again, missing)
        with progress.stage("Laying out texels"):
            return capture, texels(capture.mesh, size)

    def _capture(self, progress: Progress, again: bool, missing: Missing) -> Capture:
        from svu_mi.capture import has_photographs, load_capture, photographs_of, render_capture
        from svu_mi.capture.rendering import require_rendered

        images, defines = self.images, self.defines()
        live = images is None and self.scene.suffix.lower() == ".xml" and missing == "refuse"
        if live and not has_photographs(photographs_of(self.scene)):
            images = self.rendered
            if not (again and has_photographs(images)):
                with progress.stage("Rendering photographs") as stage:
                    capture = render_capture(
                        self.scene, self.spp, folder=images, shape=self.shape, defines=defines,
                        unwrap=self.unwrap, progress=stage.update, trust=self.trust,
                    )  # fmt: skip
                warnings.warn(
                    f"No photographs beside {self.scene} and no --images: the scene was rendered "
                    f"into {images} instead.",
                    stacklevel=1,
                )
                return capture
        with progress.stage("Loading the capture"):
            capture = load_capture(
                self.scene, images, shape=self.shape, defines=defines, unwrap=self.unwrap,
                missing=missing, trust=self.trust,
            )  # fmt: skip
            if images is not None and self.images is None:
                require_rendered(capture, self.spp)
            return capture


@dataclass(frozen=True, kw_only=True)
class Estimated(FromPhotographs):
    """Options of every command that estimates what photographs say."""

    method: Literal["angular", "spectrum"] = "angular"
    """angular: compare radiance, by statistics of all views; spectrum: compare power spectra."""
    preset: Literal["default", "fixed", "fast", "paper"] = "default"
    """paper: the published method as printed, the SH model (angular) or power spectra."""
    known: Known = ()
    """Parameters that are known, such as metallic=0: they are not estimated. "scene" stands for
    those that are constant in the scene's own material."""

    def check(self) -> None:
        """Refuse options that make no sense, before any work (see ``FromPhotographs``)."""
        super().check()
        parse_known(self.known)

    def estimate(
        self, progress: Progress, capture: Capture, texels: Texels, **options: Any
    ) -> Estimate:
        """Return what the photographs say; ``options`` are others of ``pipeline.estimate``."""
        from svu_mi.pipeline import estimate

        return estimate(
            capture, texels, self.method, self.preset, known=parse_known(self.known),
            progress=progress, **options,
        )  # fmt: skip


def say(console: Console, text: str) -> None:
    """Print a line as it is: a log has no width, and a name may hold [brackets]."""
    console.print(printable(text), markup=False, highlight=False, soft_wrap=True)


def pair(size: tuple[int, ...], option: str) -> tuple[int, int]:
    """Return (width, height) from one or two numbers.

    Raises:
        OptionError: another count of numbers, or one below 1.
    """
    if len(size) not in (1, 2) or min(size) < 1:
        raise OptionError(f"{option} takes one or two positive numbers, got {size}.")
    return size[0], size[-1]


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
        raise OptionError(f"--known must name each parameter once, got {', '.join(words)}.")
    return known or None


def was_interrupted(error: BaseException | None) -> bool:
    """Return whether Ctrl-C is behind an error: Dr.Jit wraps it, like all that a loop raises."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def given(options: Any) -> dict[str, Any]:
    """Return the options of a command by name, those of its groups too, for ``run.json``."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        found |= given(value) if dataclasses.is_dataclass(value) else {field.name: value}
    return found
