"""Options of commands that read a scene, and the way to its photographs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro
from rich.console import Console

from svu_mi.cli.common import Common as Common
from svu_mi.cli.common import Interrupted as Interrupted
from svu_mi.cli.common import Output as Output
from svu_mi.cli.common import was_interrupted as was_interrupted
from svu_mi.errors import OptionError, printable
from svu_mi.limits import Need, Sizes, require_spp, require_texels
from svu_mi.options import preset as find_preset
from svu_mi.parameters import NAMES
from svu_mi.progress import Progress

if TYPE_CHECKING:
    from svu_mi.capture import Capture
    from svu_mi.pipeline import Estimate
    from svu_mi.surface import Texels

SPECULAR = "specular"  # Ks, of the paper's power spectra

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
Folder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]
Missing = Literal["refuse", "leave-out"]
Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE.xml")]
Resolution = Annotated[tuple[int, ...], tyro.conf.arg(metavar="SIZE | WIDTH HEIGHT")]


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

    work: ClassVar[str] = "entropy"
    """What the command does, by which its need of memory is known (``limits.COSTS``)."""
    fills: ClassVar[bool] = False
    """Whether it writes maps and textures into the output folder, where no scene may lie."""
    images: Folder = None
    """Folder with the photographs: view_0000.exr, ... or named by the ids of their sensors, or as
    many as there are sensors, in the order of their names."""
    missing: Missing = "refuse"
    """What to do if sensors have no photograph: leave-out goes on with the others."""
    render: bool = False
    """Render the scene instead of reading photographs."""
    resolution: Resolution = (512,)
    """Texels per side, or width and height."""
    unwrap: bool = False
    """Lay out new UVs even if the mesh has some."""
    spp: int = 64
    """Samples per pixel, with --render."""

    @property
    def rendered(self) -> Path:
        """Where --render puts photographs."""
        return self.output / "capture"

    def check(self) -> None:
        """Refuse options that make no sense, before any work.

        Raises:
            OptionError: there is one.
        """
        require_texels(pair(self.resolution, "--resolution"), "--resolution")
        require_spp(self.spp, "--spp")
        self.defines()
        if self.render and self.images is not None:
            raise OptionError("--render has no effect with --images; omit one of them.")
        if self.render and self.scene.suffix.lower() != ".xml":
            raise OptionError(
                f"--render takes a Mitsuba scene (.xml), got {self.scene}; omit --render to read "
                "the photographs there."
            )

    def load(
        self, progress: Progress, *, again: bool = False, missing: Missing | None = None
    ) -> tuple[Capture, Texels]:
        """Load the photographs, or render them, and lay out texels.

        Args:
            progress: shows what is going on.
            again: take photographs that an earlier run has rendered into the output folder.
            missing: what to do with sensors that have no photograph, if not ``self.missing``.

        Raises:
            SceneError: the scene cannot be loaded or lacks something.
            CaptureError: photographs are missing, unreadable or do not fit, or there is not enough
                memory.
            OptionError: there are no photographs, and --render was not given.
            OutputError: the results would lie among the files of the scene.
        """
        from svu_mi.surface import texels

        if self.fills:
            from svu_mi.capture.folder import require_apart

            require_apart(self.output, self.scene)
        size = pair(self.resolution, "--resolution")
        if self.render:
            capture = self._render(progress, again)
        else:
            capture = self._read(progress, self.images, missing or self.missing)
        with progress.stage("Laying out texels"):
            return capture, texels(capture.mesh, size)

    def need(self, sizes: Sizes) -> Need:
        """Return what memory the command takes."""
        return Need(
            self.work, sizes.photographs, pair(self.resolution, "--resolution"),
            light=sizes.light, charts=sizes.charts,
        )  # fmt: skip

    def _read(self, progress: Progress, images: Path | None, missing: Missing) -> Capture:
        from svu_mi.capture import load_capture
        from svu_mi.capture.matching import NoPhotographsError, photographs_of

        _ = photographs_of(self.scene)  # refuses what is not there
        with progress.stage("Loading the capture"):
            try:
                return load_capture(
                    self.scene, images, shape=self.shape, defines=self.defines(),
                    unwrap=self.unwrap, missing=missing, trust=self.trust,
                    preflight=announcing(progress, str(images or self.scene), self.need),
                )  # fmt: skip
            except NoPhotographsError as error:
                if images is not None or self.scene.suffix.lower() != ".xml":
                    raise
                raise OptionError(
                    f"{self.scene}: no photographs beside it; give their folder with --images, or "
                    f"--render to render the scene itself ({error.sensors} sensors)."
                ) from error

    def _render(self, progress: Progress, again: bool) -> Capture:
        from svu_mi.capture import render_capture
        from svu_mi.capture.matching import has_photographs
        from svu_mi.capture.rendering import require_rendered

        images = self.rendered
        if again and has_photographs(images):
            capture = self._read(progress, images, "refuse")
            require_rendered(capture, self.spp)
            return capture
        with progress.stage("Rendering photographs") as stage:
            return render_capture(
                self.scene, self.spp, folder=images, shape=self.shape, defines=self.defines(),
                unwrap=self.unwrap, progress=stage.update, trust=self.trust,
                preflight=announcing(progress, str(self.scene), self.need),
            )  # fmt: skip


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
        find_preset(self.preset, method=self.method)
        parse_known(self.known)

    def need(self, sizes: Sizes) -> Need:
        """Return what memory the command takes (see ``FromPhotographs``)."""
        model = self.preset if self.method == "angular" else self.method
        return dataclasses.replace(super().need(sizes), model=model)

    def estimate(
        self, progress: Progress, capture: Capture, texels: Texels, **options: Any
    ) -> Estimate:
        """Return what the photographs say; ``options`` are others of ``pipeline.estimate``."""
        from svu_mi.pipeline import estimate

        return estimate(
            capture, texels, self.method, self.preset, known=parse_known(self.known),
            progress=progress, **options,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class WithPictures:
    """The option of commands that draw pictures beside what they compute."""

    pictures: bool = True
    """Draw PNG pictures of the results, too."""


def announcing(
    progress: Progress, label: str, need: Callable[[Sizes], Need]
) -> Callable[[Sizes], None]:
    """Return what refuses sizes that need too much memory, and announces the others.

    Args:
        progress: says so.
        label: begins the refusal: the scene, or the folder of the photographs.
        need: of how large everything is.
    """

    def preflight(sizes: Sizes) -> None:
        found = need(sizes)
        found.require(label)
        progress.say(found.sentence())

    return preflight


def say(console: Console, text: str) -> None:
    """Print a line as it is: a log has no width, and a name may hold [brackets]."""
    console.print(printable(text), markup=False, highlight=False, soft_wrap=True)


def pair(size: tuple[int, ...], option: str) -> tuple[int, int]:
    """Return (width, height) from one or two numbers.

    Raises:
        OptionError: another count of numbers, or one below 1.
    """
    if len(size) not in (1, 2) or min(size) < 1:
        found = " ".join(map(str, size))
        raise OptionError(f"{option} takes one or two positive numbers, got {found}.")
    return size[0], size[-1]


def with_known_repeated(words: Sequence[str]) -> list[str]:
    """Return the words of a command with ``--known a=0 b=1`` as ``--known a=0 --known b=1``.

    An option that takes any number of words would take the scene after it, too.
    """
    spread: list[str] = []
    for word in words:
        name, is_value, _ = word.partition("=")
        if spread[-2:-1] == ["--known"] and is_value and name in (*NAMES, SPECULAR):
            spread.append("--known")
        spread.append(word)
    return spread


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
    for name in known:
        if name not in (*NAMES, SPECULAR):
            raise OptionError(
                f"--known: there is no parameter {name!r}; use {', '.join(NAMES[:-1])} or "
                f"{NAMES[-1]}."
            )
    return known or None


def given(options: Any) -> dict[str, Any]:
    """Return the options of a command by name, those of its groups too, for ``run.json``."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        found |= given(value) if dataclasses.is_dataclass(value) else {field.name: value}
    return found
