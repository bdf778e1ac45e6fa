"""``svu light``: estimate the light from photographs."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, arg

from svu_mi.calibration.light.light_options import LightOptions
from svu_mi.cli import shared_options as opt
from svu_mi.cli.base_command import ResultCommand, interruptible
from svu_mi.cli.loading import CaptureCommand, light_search_need
from svu_mi.core.io.output_folder import Claim
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError

if TYPE_CHECKING:
    from svu_mi.calibration.light.light_estimate import LightEstimate
    from svu_mi.capture.capture import Capture

Depths = Annotated[tuple[tuple[int, int], ...], arg(metavar="CELLS ROUNDS ...")]
Card = Annotated[
    tuple[float, float, float] | None, arg(metavar="U V ALBEDO", help_behavior_hint="")
]
Switch = FlagCreatePairsOff[bool]
MIN_SCALE = 1e-6  # factor of brightness
FINEST_MEAN, FINEST_CARD = 64, 128  # texels per side for comparing base colours


@dataclass(frozen=True, kw_only=True)
class FindLight(CaptureCommand, ResultCommand):
    """Estimate the environment map from the photographs.

    Writes light.exr (a map in the frame of Mitsuba's envmap, with layers of its uncertainty),
    light.npz (for --light of other commands), light.png and light.json. Other commands use the
    copy that is kept in the capture. If the capture has a light, the estimate ignores it and is
    compared with it.
    """

    command = "light"
    first = "scene output images gains light-moves light-fixed background grey-card mean-albedo"
    output: opt.Output = Path("out/light")
    resolution: opt.Size = (256,)
    """Texels per side, or width and height, of the grid that texels are sampled from."""
    texels: int = LightOptions.texels
    """Maximum number of sampled texels, in [16, 10000]; more take longer and change little."""
    depths: Depths = LightOptions.depths
    """Pairs: cells of the sphere, in [64, 4096] and ascending, and iterations with them; more
    cells resolve smaller lamps."""
    seed: int = LightOptions.seed
    """Random seed of the posterior samples of the light; at least 0."""
    light_moves: Switch = False
    """The light moves with the camera: turntable or flash (default: both cases are tested)."""
    light_fixed: Switch = False
    """The light is fixed: only the camera moved (default: both cases are tested)."""
    known: opt.Known = ()
    background: Literal["none", "distant"] = "none"
    """distant: pixels outside the object show the light; wrong in a light tent or near walls."""
    light_scale: opt.Number = None
    """Factor of the estimated radiance, if the brightness is known (default: 1)."""
    mean_albedo: opt.Number = None
    """Mean base colour of the seen surface, in (0, 1]; sets the brightness (default: unknown)."""
    grey_card: Card = None
    """Texture coordinates of a grey spot that is not metallic, and its base colour, all in [0, 1];
    sets brightness and colour (default: unknown)."""
    pictures: opt.Pictures = True

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        from svu_mi.calibration.light.grey_card import require_albedo

        super().check()
        opt.parse_resolution(self.resolution)
        if self.light_moves and self.light_fixed:
            raise OptionError("--light-moves and --light-fixed exclude each other; omit one.")
        self._options()
        facts = {"--light-scale": self.light_scale, "--mean-albedo": self.mean_albedo,
                 "--grey-card": self.grey_card}  # fmt: skip
        several = [name for name, value in facts.items() if value is not None]
        if len(several) > 1:
            raise OptionError(f"{' and '.join(several)} exclude each other; give one.")
        opt.require_range("--light-scale", self.light_scale, MIN_SCALE, 1 / MIN_SCALE)
        if self.mean_albedo is not None:
            require_albedo(self.mean_albedo, "--mean-albedo")
        if self.grey_card is not None:
            u, v, albedo = self.grey_card
            require_albedo(albedo, "--grey-card")
            if not (0 <= u <= 1 and 0 <= v <= 1):
                raise OptionError(
                    f"--grey-card: texture coordinates are in [0, 1], got {u:g} {v:g}."
                )

    def _options(self) -> LightOptions:
        """Return the options of the estimate of the light."""
        moves = self.light_moves if self.light_moves or self.light_fixed else None
        known = opt.parse_known(self.known) or {}
        if known == "scene":
            raise OptionError("--known of svu light takes metallic=VALUE.")
        return LightOptions(
            texels=self.texels, depths=self.depths, seed=self.seed, moves=moves,
            background=self.background, known=known,
            gains=bool(self.capture.photographs.estimates_gains),
        )  # fmt: skip

    def work(self, progress: Progress, place: Claim) -> list[str]:
        """Estimate the light, write it, and return a summary."""
        from svu_mi.calibration.light import light_summary as summary
        from svu_mi.calibration.light.estimate_light import estimate_light
        from svu_mi.calibration.light.resolve_light import keep_light, with_needed_gains
        from svu_mi.capture.up_direction import up_direction
        from svu_mi.output.light_page import write_light

        options, size = self._options(), opt.parse_resolution(self.resolution)
        need = partial(light_search_need, resolution=size, options=options)
        surroundings = self.background != "none"
        capture, grid = self.load(progress, need, size, surroundings=surroundings)
        own = capture.environment
        known = capture.exposures_known or own is not None or surroundings
        unknown = self.capture.photographs.estimates_gains is None and not known
        if own is not None:
            progress.say("The light of the capture is used for comparison only.")
        self._require_spot(progress, capture)
        with interruptible(lambda: "interrupted; run the same command again"):
            options = replace(options, gains=options.gains or unknown)
            light = estimate_light(capture, grid, options, progress)
            if unknown:
                light, sentence = with_needed_gains(light)
                progress.say(sentence)
            light = self._scaled(progress, capture, light)
        against = None if own is None or light.moves else summary.compare_lights(light, own)
        with progress.stage("Writing the results"):
            run = self.run_info(progress)
            write_light(
                capture, light, place, run, used=asdict(options), against=against,
                timings=progress.timings, pictures=self.pictures,
            )  # fmt: skip
        if own is None:
            used = {"used": asdict(options), "resolution": size}
            keep_light(light, capture, self.output, used, progress)
        lines = list(summary.summary_sentences(light, up_direction(capture)))
        if light.gains is not None:
            lines += summary.gain_sentences(light.gains, capture)
        return lines if against is None else [*lines, summary.comparison_sentence(against)]

    def _require_spot(self, progress: Progress, capture: Capture) -> None:
        """Refuse a grey card that no photograph shows."""
        from svu_mi.calibration.light.grey_card import texels_at
        from svu_mi.geometry.texels import texels
        from svu_mi.posterior.observations import observe

        if self.grey_card is not None:
            seen = observe(capture, texels(capture.mesh, FINEST_CARD), progress)
            texels_at(seen, self.grey_card[:2])

    def _scaled(self, progress: Progress, capture: Capture, light: LightEstimate) -> LightEstimate:
        """Return the light scaled by --light-scale, --mean-albedo or --grey-card."""
        from svu_mi.calibration.exposure import equalized
        from svu_mi.calibration.light.grey_card import scaled_by_card, scaled_by_mean
        from svu_mi.geometry.texels import texels
        from svu_mi.posterior.observations import observe

        if self.light_scale is not None:
            return light.scaled(self.light_scale)
        if self.mean_albedo is None and self.grey_card is None:
            return light
        if light.gains is not None:
            capture = equalized(capture, light.gains)
        finest = FINEST_MEAN if self.grey_card is None else FINEST_CARD
        seen = observe(capture, texels(capture.mesh, finest), progress)
        with progress.stage("Comparing base colours"):
            if self.grey_card is not None:
                return scaled_by_card(light, seen, self.grey_card[:2], self.grey_card[2])
            assert self.mean_albedo is not None
            return scaled_by_mean(light, seen, self.mean_albedo)
