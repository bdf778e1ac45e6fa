"""Load the capture of a command: plan, check memory, read or render photographs, find a light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from svu_mi.cli.options import CaptureOptions, Missing, PhotographOptions, SceneOptions
from svu_mi.errors import OptionError
from svu_mi.memory import Need, Sizes
from svu_mi.progress import Progress

if TYPE_CHECKING:
    from svu_mi.capture import Capture
    from svu_mi.capture.window import Detail
    from svu_mi.illumination.options import LightOptions
    from svu_mi.surface import Texels

EQUATIONS = 26  # memory of six matrices of 3 N x 3 N, in that of a look
NeedOf = Callable[[Sizes], Need]


@dataclass(frozen=True, kw_only=True)
class Loading:
    """How a command loads its capture.

    Attributes:
        options: the scene and its photographs.
        resolution: texels, (width, height).
        need: memory of the command by sizes.
        trust: whether the scene may load libraries.
        folder: of photographs that ``--render`` makes.
        spp: their samples per pixel.
        again: read photographs that an earlier run has rendered.
        missing: replaces the option of that name.
        surroundings: whether pixels beside the object are used.
    """

    options: CaptureOptions
    resolution: tuple[int, int]
    need: NeedOf
    trust: bool
    folder: Path
    spp: int
    again: bool = False
    missing: Missing | None = None
    surroundings: bool = False

    def load(self, progress: Progress) -> tuple[Capture, Texels]:
        """Read or render the photographs, and lay out texels; there may be no light.

        Raises:
            SceneError: the scene cannot be loaded or lacks something.
            CaptureError: photographs are missing, unreadable or do not fit, or there is not enough
                memory.
            OptionError: there are no photographs, and --render was not given.
        """
        from svu_mi.surface import texels

        if self.options.rendering.render:
            capture = self._rendered(progress)
        else:
            capture = self._read(progress, self.options.photographs)
        with progress.stage("Laying out texels"):
            return capture, texels(capture.mesh, self.resolution)

    def load_lit(
        self, progress: Progress, light: Path | None, kept: Path
    ) -> tuple[Capture, Texels]:
        """Load the capture with a light, which is found in the photographs if need be.

        Args:
            progress: shows stages.
            light: a folder of ``svu light``, or a map; replaces the scene's light.
            kept: folder of light that is found, if nothing can be written beside the photographs.

        Raises:
            CaptureError: the given light is invalid, or the photographs do not determine it.
            SceneError: it moves with the cameras.
        """
        from svu_mi.illumination.resolve_light import illuminated

        need = self.need
        if light is None:
            need = with_search(need)
        capture, grid = replace(self, need=need).load(progress)
        gains = self.options.photographs.estimates_gains
        lit = illuminated(capture, light, elsewhere=kept, gains=gains, progress=progress)
        return lit, grid

    def _read(self, progress: Progress, photographs: PhotographOptions) -> Capture:
        from svu_mi.capture.matching import NoPhotographsError, photographs_of
        from svu_mi.capture.window import Detail

        source = self.options.source
        _ = photographs_of(source.scene)  # raises if it does not exist
        detail = Detail(texels=self.resolution, surroundings=self.surroundings)
        try:
            return read_capture(
                progress, source, photographs, self.need, detail, trust=self.trust,
                unwrap=self.options.rendering.unwrap, missing=self.missing,
            )  # fmt: skip
        except NoPhotographsError as error:
            if photographs.images is not None or source.scene.suffix.lower() != ".xml":
                raise
            raise OptionError(
                f"{source.scene}: no photographs beside it; give their folder with --images, or "
                f"--render to render the scene itself ({error.sensors} sensors)."
            ) from error

    def _rendered(self, progress: Progress) -> Capture:
        from svu_mi.capture.matching import has_photographs
        from svu_mi.capture.rendering import plan_render, require_rendered

        source, rendering = self.options.source, self.options.rendering
        if self.again and has_photographs(self.folder):
            photographs = replace(self.options.photographs, images=self.folder, missing="refuse")
            capture = replace(self, missing=None)._read(progress, photographs)
            require_rendered(capture, self.spp)
            return capture

        def need(sizes: Sizes) -> Need:
            return max(Need.of("render", sizes), self.need(sizes), key=lambda one: one.bytes)

        with progress.stage("Rendering photographs") as stage:
            plan = plan_render(
                source.scene, self.spp, shape=source.shape, defines=source.defines(),
                unwrap=rendering.unwrap, trust=self.trust,
            )  # fmt: skip
            announce_sizes(progress, str(source.scene), need, plan.sizes)
            return plan.render(self.folder, progress=stage.update)


def read_capture(
    progress: Progress,
    source: SceneOptions,
    photographs: PhotographOptions,
    need: NeedOf,
    detail: Detail,
    *,
    trust: bool,
    unwrap: bool = False,
    missing: Missing | None = None,
) -> Capture:
    """Plan a capture, check its memory, and read it (see ``capture.loading.plan_capture``)."""
    from svu_mi.capture.loading import plan_capture

    with progress.stage("Loading the capture"):
        plan = plan_capture(
            source.scene, photographs.images, shape=source.shape, defines=source.defines(),
            unwrap=unwrap, missing=missing or photographs.missing, trust=trust, light="optional",
            detail=detail,
        )  # fmt: skip
        label, sizes = str(photographs.images or source.scene), plan.sizes(photographs.bytes)
        return plan.read(announce_sizes(progress, label, need, sizes))


def announce_sizes(progress: Progress, label: str, need: NeedOf, sizes: Sizes) -> float:
    """Refuse sizes that need too much memory, and announce others.

    Args:
        progress: shows the sentence.
        label: begins the refusal: the scene, or the folder of the photographs.
        need: memory of a command by sizes.
        sizes: of the capture.

    Returns:
        Bytes that photographs may take: 0 where all else needs the memory, unless a size was asked
        for.
    """
    found = need(sizes)
    if not (found.fits or sizes.asked):
        found = need(replace(sizes, memory=0.0))
    announce(progress, label, found)
    return found.memory


def announce(progress: Progress, label: str, need: Need) -> None:
    """Refuse what needs too much memory, and announce what does not (see ``announce_sizes``)."""
    need.require(label)
    progress.say(need.sentence())


def to_find_light(sizes: Sizes, resolution: tuple[int, int], options: LightOptions) -> Need:
    """Return what memory it takes to find the light."""
    cells = max(cells for cells, _ in options.depths)
    # Of few texels, the normal equations of the cells take more than the texels' part of them.
    equations = EQUATIONS * cells**2 // max(len(sizes.photographs), 1)
    looks = max(options.texels * cells, equations)
    # No statistics are gathered: texels take no more than where spectra are fitted.
    return Need.of("light", sizes, resolution, looks=looks, model="spectrum")


def with_search(need: NeedOf) -> NeedOf:
    """Return the memory of a command that first finds the light, if there is none."""
    from svu_mi.illumination.resolve_light import OPTIONS, RESOLUTION

    def larger(sizes: Sizes) -> Need:
        if sizes.lit:
            return need(sizes)
        search = to_find_light(sizes, (RESOLUTION, RESOLUTION), OPTIONS)
        return max(need(sizes), search, key=lambda one: one.bytes)

    return larger
