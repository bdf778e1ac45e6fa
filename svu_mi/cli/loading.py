"""Loading of captures: plan, check memory, read or render, estimate the light."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from svu_mi.cli import shared_options as opt
from svu_mi.cli.base_command import BaseCommand
from svu_mi.core.memory import Need, Sizes, search_bytes
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError, counted, warn
from svu_mi.parameters import MIXED

if TYPE_CHECKING:
    from svu_mi.calibration.light.light_options import LightOptions
    from svu_mi.capture.capture import Capture
    from svu_mi.capture.crop import Detail
    from svu_mi.geometry.texels import Texels
    from svu_mi.posterior.estimate import Estimate

NeedFunc = Callable[[Sizes], Need]

WIDENED = 1.5  # factor of error bars from which it is printed


@dataclass(frozen=True, kw_only=True)
class CaptureCommand(BaseCommand):
    """Options of every command that loads a capture."""

    capture: opt.CaptureOptions
    spp: opt.Samples = 64
    output: opt.Output = Path("out")

    @property
    def side_folders(self) -> tuple[Path, Path]:
        """Folders of the rendered photographs and of the estimated light."""
        return self.output / "capture", self.output / "light"

    def load(
        self, progress: Progress, need: NeedFunc, size: tuple[int, int], *, again: bool = False,
        missing: opt.Missing | None = None, surroundings: bool = False,
    ) -> tuple[Capture, Texels]:  # fmt: skip
        """Read or render the photographs, and lay out texels; the light is optional.

        ``need`` returns the needed memory for given sizes. ``size`` is (width, height) in texels.
        ``again`` reads the photographs that an earlier run rendered, ``missing`` replaces the
        option of the same name, and ``surroundings`` keeps pixels outside the object.
        """
        from svu_mi.capture.crop import Detail
        from svu_mi.capture.match_photographs import has_photographs
        from svu_mi.capture.rendering import require_rendered
        from svu_mi.geometry.texels import texels

        photographs = self.capture.photographs
        detail = Detail(texels=size, surroundings=surroundings)
        if missing is not None:
            photographs = replace(photographs, missing=missing)
        if not self.capture.rendering.render:
            capture = self._read(progress, photographs, need, detail)
        elif again and has_photographs(self.side_folders[0]):
            rendered = replace(photographs, images=self.side_folders[0], missing="refuse")
            capture = self._read(progress, rendered, need, detail)
            require_rendered(capture, self.spp)
        else:
            capture = self._render(progress, need)
        with progress.stage("Laying out texels"):
            return capture, texels(capture.mesh, size)

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        self.capture.check(self.spp)

    def _read(
        self, progress: Progress, photographs: opt.PhotographOptions, need: NeedFunc,
        detail: Detail,
    ) -> Capture:  # fmt: skip
        from svu_mi.capture.match_photographs import NoPhotographsError, photographs_of

        source = self.capture.source
        _ = photographs_of(source.scene)  # raises if it does not exist
        unwrap = self.capture.rendering.unwrap
        try:
            return read_capture(
                progress, source, photographs, need, detail, trust=self.trust, unwrap=unwrap
            )
        except NoPhotographsError as error:
            if photographs.images is not None or source.scene.suffix.lower() != ".xml":
                raise
            raise OptionError(
                f"{source.scene}: no photographs next to it; give their folder with --images, or "
                f"--render to render the scene itself ({counted(error.sensors, 'sensor')})."
            ) from error

    def _render(self, progress: Progress, need: NeedFunc) -> Capture:
        from svu_mi.capture.rendering import plan_render

        source, unwrap = self.capture.source, self.capture.rendering.unwrap
        with progress.stage("Rendering photographs") as stage:
            plan = plan_render(
                source.scene, self.spp, shape=source.shape, defines=source.defines(),
                unwrap=unwrap, trust=self.trust,
            )  # fmt: skip
            photograph_memory(
                progress, str(source.scene), largest_need(partial(Need, "render"), need), plan.sizes
            )
            return plan.render(self.side_folders[0], progress=stage.update)


@dataclass(frozen=True, kw_only=True)
class LitCommand(CaptureCommand):
    """Options of every command that needs the light and statistics of a capture."""

    light: opt.GivenLight = None
    convention: opt.MapOptions = opt.MapOptions()
    kept: opt.CacheOptions = opt.CacheOptions()

    def load_with_light(
        self, progress: Progress, need: NeedFunc, size: tuple[int, int],
        known: opt.Known = (), **options: Any,
    ) -> tuple[Capture, Texels]:  # fmt: skip
        """Load the capture with the given light, its own, or an estimated one, and its cache."""
        from svu_mi.calibration.light.resolve_light import with_resolved_light

        need = with_light_search(need) if self.light is None else need
        capture, grid = self.load(progress, need, size, **options)
        gains, folder = self.capture.photographs.estimates_gains, self.side_folders[1]
        lit = with_resolved_light(
            capture, self.convention.light(self.light), elsewhere=folder, gains=gains,
            progress=progress, known=opt.known_values(known, capture.shape, MIXED),
        )  # fmt: skip
        return self.kept.of(lit, progress), grid

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        super().check()
        _ = self.kept.bytes, self.convention.light(self.light)


@dataclass(frozen=True, kw_only=True)
class EstimateCommand(LitCommand):
    """Options of every command that estimates the posterior."""

    estimation: opt.EstimateOptions = opt.EstimateOptions()
    resolution: opt.Size = ()

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        super().check()
        if self.resolution:
            opt.parse_resolution(self.resolution)
        self.estimation.check()

    def load_and_estimate(
        self, progress: Progress, size: tuple[int, int], command: str,
        recovered: Path | None = None, **options: Any,
    ) -> tuple[Capture, Estimate]:  # fmt: skip
        """Load the capture, check that ``recovered`` belongs to it, and estimate its posterior."""
        from svu_mi.output.texture_files import capture_of_textures

        need = partial(Need, command, resolution=size, model=self.estimation.model)
        capture, grid = self.load_with_light(progress, need, size, self.estimation.known)
        if recovered is not None:
            capture = capture_of_textures(capture, recovered)
            for sentence in _differences(recovered, self.estimation):
                capture = capture.warned(f"{recovered}: {sentence}")
        estimate = self.estimation.estimate(progress, capture, grid, **options)
        print_prediction(progress, estimate)
        return capture, estimate


def _differences(recovered: Path, own: opt.EstimateOptions) -> Iterator[str]:
    """Yield sentences on options of a recovery that change shares and intervals."""
    from svu_mi.output.texture_files import recovery_settings

    given = recovery_settings(recovered, "given")
    here = {"known": list(own.known), "bounces": own.bounces}
    if other := [f"--{name}" for name in here if given.get(name, here[name]) != here[name]]:
        yield (
            f"recovered with other {' and '.join(other)}; give the same here, or shares, maps and "
            "probabilities are of another estimate than the textures."
        )
    if given.get("sharing"):
        yield (
            "recovered with sharing; shares, maps and probabilities here are of single texels "
            "without it, so that shares differ from those that svu recover printed."
        )


def print_prediction(progress: Progress, estimate: Estimate) -> None:
    """Print the widening of error bars, and the prediction, as a warning if it is bad."""
    widened = max(estimate.posterior.kernel.spread.values(), default=1.0)
    if widened > WIDENED:
        progress.say(
            f"Error bars are widened up to {widened:.2g} times, because groups of photographs "
            "disagree; more photographs may gain more than svu guide expects."
        )
    predicted, sentence = estimate.prediction, estimate.prediction_sentence
    if predicted is None or sentence is None:
        return
    if predicted.reliable and not predicted.odd():
        progress.say(sentence)
    else:
        warn(sentence)


def read_capture(
    progress: Progress,
    source: opt.SceneOptions,
    photographs: opt.PhotographOptions,
    need: NeedFunc,
    detail: Detail,
    *,
    trust: bool,
    unwrap: bool = False,
) -> Capture:
    """Check the memory that a capture needs, and read it (see ``plan_capture``)."""
    from svu_mi.capture.loading import plan_capture

    with progress.stage("Loading the capture"):
        plan = plan_capture(
            source.scene, photographs.images, shape=source.shape, defines=source.defines(),
            unwrap=unwrap, missing=photographs.missing, trust=trust, light="optional",
            detail=detail,
        )  # fmt: skip
        label, sizes = str(photographs.images or source.scene), plan.sizes(photographs.bytes)
        if absent := plan.match.paths.count(None):
            sensors = counted(len(plan.match.paths), "sensor")
            progress.say(f"{absent} of {sensors} have no photograph.")
        return plan.read(photograph_memory(progress, label, need, sizes))


def photograph_memory(progress: Progress, label: str, need: NeedFunc, sizes: Sizes) -> float:
    """Check and print the needed memory; return the bytes available for photographs.

    Without --memory, the result is 0 if the rest of the command needs all memory.
    """
    required = need(sizes)
    if not (required.fits or sizes.asked):
        required = need(replace(sizes, memory=0.0))
    require_memory(progress, label, required)
    return required.sizes.memory


def require_memory(progress: Progress, label: str, need: Need) -> None:
    """Print the needed memory; raise ``CaptureError`` if it exceeds the available memory."""
    need.require(label)
    progress.say(need.sentence())


def light_search_need(sizes: Sizes, resolution: tuple[int, int], options: LightOptions) -> Need:
    """Return the memory that an estimate of the light needs."""
    cells, texels = max(cells for cells, _ in options.depths), options.texels
    search = search_bytes(texels * len(sizes.photographs), texels, cells)  # if all are seen
    # No statistics are gathered, so texels need as little as in the spectrum model.
    return Need("light", sizes, resolution, search=search, model="spectrum")


def with_light_search(need: NeedFunc) -> NeedFunc:
    """Return ``need``, increased where a missing light must first be estimated."""
    from svu_mi.calibration.light.resolve_light import OPTIONS, RESOLUTION

    search = partial(light_search_need, resolution=(RESOLUTION, RESOLUTION), options=OPTIONS)
    both = largest_need(need, search)
    return lambda sizes: need(sizes) if sizes.lit else both(sizes)


def largest_need(*needs: NeedFunc) -> NeedFunc:
    """Return a function of sizes that returns the largest of several needs."""
    return lambda sizes: max((need(sizes) for need in needs), key=lambda one: one.bytes)
