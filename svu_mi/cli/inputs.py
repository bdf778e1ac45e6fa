"""Options of commands that read a scene, and the way to its photographs."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from svu_mi.cli.common import Common, Output, announce_sizes
from svu_mi.cli.words import bytes_of, pair, parse_known
from svu_mi.errors import OptionError
from svu_mi.limits import require_spp, require_texels
from svu_mi.needs import Need, Sizes
from svu_mi.options import preset as find_preset
from svu_mi.progress import Progress

if TYPE_CHECKING:
    from svu_mi.capture import Capture
    from svu_mi.capture.window import Detail
    from svu_mi.illumination.options import LightOptions
    from svu_mi.pipeline import Estimate
    from svu_mi.surface import Texels

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
Given = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER | MAP")]
Memory = Annotated[str, tyro.conf.arg(metavar="SIZE")]
Missing = Literal["refuse", "leave-out"]
Gained = Literal["given", "estimate"]
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
class Photographed(OfScene):
    """Options of every command that reads photographs, whatever light they were taken under."""

    work: ClassVar[str] = "entropy"
    """What the command does, by which its need of memory is known (``needs.COSTS``)."""
    images: Folder = None
    """Folder with the photographs: view_0000.exr, ... or named by the ids of their sensors, or as
    many as there are sensors, in the order of their names."""
    missing: Missing = "refuse"
    """What to do if sensors have no photograph: leave-out goes on with the others."""
    gains: Gained = "given"
    """estimate: photographs were exposed and white-balanced one by one, by what nobody wrote down;
    both are found, and photographs that do not fit the others are named and left out."""
    render: bool = False
    """Render the scene instead of reading photographs."""
    resolution: Resolution = (512,)
    """Texels per side, or width and height."""
    unwrap: bool = False
    """Lay out new UVs even if the mesh has some."""
    spp: int = 64
    """Samples per pixel, with --render."""
    memory: Memory = ""
    """Memory that photographs may take, such as 4G; beyond it they lie in a file in TMPDIR (or
    /var/tmp) while the command runs. By default half of what is free, or nothing if all else needs
    the room."""

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
        bytes_of(self.memory, "--memory")
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
        """Load the photographs, or render them, and lay out texels; there may be no light.

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

        size = pair(self.resolution, "--resolution")
        if self.render:
            capture = self._render(progress, again)
        else:
            capture = self._read(progress, self.images, missing or self.missing)
        with progress.stage("Laying out texels"):
            return capture, texels(capture.mesh, size)

    def detail(self) -> Detail:
        """Return what is needed of large photographs."""
        from svu_mi.capture.window import Detail

        return Detail(texels=pair(self.resolution, "--resolution"))

    def need(self, sizes: Sizes) -> Need:
        """Return what memory the command takes."""
        return Need(
            self.work, sizes.photographs, pair(self.resolution, "--resolution"),
            light=sizes.light, charts=sizes.charts, stored=sizes.stored, memory=sizes.memory,
        )  # fmt: skip

    def announced(self, sizes: Sizes) -> Need:
        """Return what memory is said to be taken."""
        return self.need(sizes)

    def _read(self, progress: Progress, images: Path | None, missing: Missing) -> Capture:
        from svu_mi.capture.loading import plan_capture
        from svu_mi.capture.matching import NoPhotographsError, photographs_of

        _ = photographs_of(self.scene)  # refuses what is not there
        with progress.stage("Loading the capture"):
            try:
                plan = plan_capture(
                    self.scene, images, shape=self.shape, defines=self.defines(),
                    unwrap=self.unwrap, missing=missing, trust=self.trust, light="optional",
                    detail=self.detail(),
                )  # fmt: skip
                sizes = plan.sizes(bytes_of(self.memory, "--memory"))
                return plan.read(
                    announce_sizes(progress, str(images or self.scene), self.announced, sizes)
                )
            except NoPhotographsError as error:
                if images is not None or self.scene.suffix.lower() != ".xml":
                    raise
                raise OptionError(
                    f"{self.scene}: no photographs beside it; give their folder with --images, or "
                    f"--render to render the scene itself ({error.sensors} sensors)."
                ) from error

    def _render(self, progress: Progress, again: bool) -> Capture:
        from svu_mi.capture.matching import has_photographs
        from svu_mi.capture.rendering import plan_render, require_rendered

        images = self.rendered
        if again and has_photographs(images):
            capture = self._read(progress, images, "refuse")
            require_rendered(capture, self.spp)
            return capture
        with progress.stage("Rendering photographs") as stage:
            plan = plan_render(
                self.scene, self.spp, shape=self.shape, defines=self.defines(),
                unwrap=self.unwrap, trust=self.trust,
            )  # fmt: skip
            announce_sizes(progress, str(self.scene), self._need_rendered, plan.sizes)
            return plan.render(images, progress=stage.update)

    def _need_rendered(self, sizes: Sizes) -> Need:
        """Return what takes more memory: to render the photographs, or what is done with them."""
        rendering = Need("render", sizes.photographs, light=sizes.light, model="")
        return max(rendering, self.announced(sizes), key=lambda need: need.bytes)


@dataclass(frozen=True, kw_only=True)
class FromPhotographs(Photographed):
    """Options of every command that asks photographs what they say of reflectance."""

    light: Given = None
    """The light: a folder that svu light wrote, or a lat-long map (EXR or HDR; top +Y, centre +Z),
    in the place of the scene's own. Without any, it is found in the photographs, and kept beside
    them in the folder light."""

    def load(
        self, progress: Progress, *, again: bool = False, missing: Missing | None = None
    ) -> tuple[Capture, Texels]:
        """Load the photographs (see ``Photographed``) with a light, which is found if need be.

        Raises:
            CaptureError: the light that is given is none, or the photographs do not tell it.
            SceneError: it moves with the cameras.
        """
        from svu_mi.illumination.resolve_light import illuminated

        capture, grid = super().load(progress, again=again, missing=missing)
        lit = illuminated(
            capture, self.light, elsewhere=self.own_light, gains=self.gains == "estimate",
            progress=progress,
        )  # fmt: skip
        return lit, grid

    @property
    def own_light(self) -> Path:
        """Where light that was found is kept, if nothing can be written beside the photographs."""
        return self.output / "light"

    def announced(self, sizes: Sizes) -> Need:
        """Return what memory is said to be taken."""
        need = self.need(sizes)
        return need if self.light is not None else with_search(need, sizes)


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


EQUATIONS = 26  # memory of six matrices of 3 N x 3 N, in that of a look


def to_find_light(sizes: Sizes, resolution: tuple[int, int], options: LightOptions) -> Need:
    """Return what memory it takes to find the light."""
    cells = max(cells for cells, _ in options.depths)
    # Of few texels, the normal equations of the cells take more than the texels' part of them.
    equations = EQUATIONS * cells**2 // max(len(sizes.photographs), 1)
    looks = max(options.texels * cells, equations)
    # No statistics are gathered: texels take no more than where spectra are fitted.
    return Need(
        "light", sizes.photographs, resolution, looks=looks, model="spectrum", charts=sizes.charts,
        stored=sizes.stored, memory=sizes.memory,
    )  # fmt: skip


def with_search(need: Need, sizes: Sizes) -> Need:
    """Return what memory a command takes at most, that finds the light first if there is none."""
    from svu_mi.illumination.resolve_light import OPTIONS, RESOLUTION

    if sizes.lit:
        return need
    search = to_find_light(sizes, (RESOLUTION, RESOLUTION), OPTIONS)
    return max(need, search, key=lambda one: one.bytes)
