"""``svu recover``: recovery of textures from photographs."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from svu_mi.cli import shared_options as opt
from svu_mi.cli.base_command import ResultCommand, interruptible
from svu_mi.cli.loading import LitCommand, print_prediction
from svu_mi.core.io.output_folder import CHECKPOINT, Claim
from svu_mi.core.memory import Need
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.parameters import NAMES
from svu_mi.presets import preset as find_preset
from svu_mi.recovery.recovery_options import PAPER_PRESETS

if TYPE_CHECKING:
    from svu_mi.output.interval_summary import IntervalSummary

MOST_DRAWS = 1000
Name = Literal[NAMES]  # type: ignore[valid-type]
Parameters = Annotated[tuple[Name, ...], arg(metavar=f"{{{','.join(NAMES)}}} ...")]
Drawn = Annotated[int, arg(name="draws")]
From = Annotated[Path | None, arg(name="start", metavar="FOLDER")]


@dataclass(frozen=True, kw_only=True)
class Recover(LitCommand, ResultCommand):
    """Recover base colour, roughness and metallic textures.

    Writes EXR textures, recovered.xml (a Mitsuba scene with them), coverage.exr, entropy.exr,
    uncertainty.exr (standard deviations, 90 % intervals), pictures, losses.csv and run.json.
    """

    command, keep = "recover", CHECKPOINT
    first = "scene output resolution light images method preset sharing draws resume"
    output: opt.Output = Path("out/textures")
    resolution: opt.Resolution = (512,)
    method: Literal["sh", "path", "sh+path"] = "sh"
    """sh: direct light, in seconds; path: Mitsuba's path tracer in a loop, with indirect light, in
    minutes; sh+path: one epoch of path after sh."""
    preset: Literal["default", "paper", "coefficients", "spectrum", "polish", "paper_polish"] = (
        "default"
    )
    """paper: the published losses and rates; coefficients, spectrum: other losses of the paper,
    for sh; polish, paper_polish: only the last step of sh+path, one epoch of path."""
    sharing: bool = False
    """Learn a prior from all texels, for objects of few materials. The presets of the paper then
    use its Eq. 14 and 15."""
    tv: opt.Number = None
    """Weight of total variation, at least 0; larger: smoother (default: from the preset)."""
    epochs: opt.Number = None
    """Number of times that path uses each pixel, more than 0 (default: from the preset)."""
    steps: opt.Count = None
    """Gradient steps of sh, at least 1 (default: from the preset)."""
    parameters: Parameters = NAMES
    """Textures to recover; the others keep their initial values (see --start)."""
    known: opt.Known = ()
    bounces: bool = False
    """Account for light that the object reflects onto itself, as bright as it is in the
    photographs; takes up to twice as long. Not for the presets of the paper."""
    normals: bool = False
    """Tilt the normals smoothly so that the model agrees with the photographs, for shiny objects of
    inexact meshes; writes normal.exr (a normal map) and normal_sd.exr (degrees)."""
    initial: From = None
    """Folder of the initial base_color.exr, roughness.exr and metallic.exr (default: posterior
    means for sh; 0.5 for path and the presets of the paper)."""
    resume: bool = False
    """Continue an interrupted run from its checkpoint in the output folder."""
    checkpoint_seconds: float = 30.0
    """Seconds between two checkpoints, at least 0."""
    drawn: Drawn = 0
    """Number of posterior samples of the textures, in [0, 1000], written to draws/ and draws.png;
    svu relight needs about 16."""
    seed: int = 0
    """Random seed of path and of the draws, at least 0."""
    pictures: opt.Pictures = True

    def work(self, progress: Progress, place: Claim) -> list[str]:
        """Recover the textures, and write the results."""
        checkpoint = place.draft / CHECKPOINT
        self._check_checkpoint(checkpoint)
        with interruptible(partial(_advice, checkpoint)):
            return [self._recover(progress, place).summary()]

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        super().check()
        opt.parse_resolution(self.resolution)
        opt.parse_known(self.known)
        if self.bounces and (self.preset in PAPER_PRESETS or self.method == "path"):
            raise OptionError("--bounces needs the method sh, and no preset of the paper.")
        if not self.parameters:
            raise OptionError("--parameters must name at least one texture.")
        opt.require_range("--seed", self.seed, 0)
        opt.require_range("--draws", self.drawn, 0, MOST_DRAWS)
        opt.require_range("--checkpoint-seconds", self.checkpoint_seconds, 0)
        if self.drawn and self.preset in PAPER_PRESETS:
            raise OptionError(
                f"--draws needs the noise of the photographs, which --preset {self.preset} does "
                "not estimate; omit one of them."
            )

    def _check_checkpoint(self, checkpoint: Path) -> None:
        if self.resume:
            if not checkpoint.exists():
                raise OptionError(f"{self.output}: no checkpoint to resume from; omit --resume.")
        elif self.overwrite:
            checkpoint.unlink(missing_ok=True)
        elif checkpoint.exists():
            raise OptionError(
                f"{self.output}: an interrupted run has left a checkpoint; continue it with "
                "--resume and the same options, or start again with --overwrite."
            )

    def _recover(self, progress: Progress, place: Claim) -> "IntervalSummary":
        from svu_mi.calibration.checks.exposure_checks import warn_of_exposure
        from svu_mi.calibration.normals.refine_normals import refine_normals
        from svu_mi.geometry.texels import texels as make_texels
        from svu_mi.output.interval_summary import IntervalSummary
        from svu_mi.output.write_recovery import write_recovery
        from svu_mi.pipeline import estimate
        from svu_mi.posterior.observations import observe
        from svu_mi.recovery.initialisation import supports_texture_field
        from svu_mi.recovery.recover import recover
        from svu_mi.recovery.uncertainty.texture_field import texture_field

        options = self._options()  # fail before any work
        size = opt.parse_resolution(self.resolution)
        need = partial(Need, "recover", resolution=size, model="default")
        capture, texels = self.load_with_light(progress, need, size, self.known, again=self.resume)
        refined = refine_normals(capture, size, progress) if self.normals else None
        if refined is not None:
            capture, texels = refined.capture, make_texels(refined.capture.mesh, size)
        _, initial = opt.read_recovered(self.initial, texels.resolution, one_run=False)
        seen = observe(capture, texels, progress)
        # Losses of the paper are combined with the posterior of its model.
        model = "paper" if self.preset in PAPER_PRESETS else "default"
        fixed, given = opt.parse_known(self.known), None
        switches = find_preset(model, method="angular", bounces=self.bounces)
        if fixed is not None or self.bounces:
            given = estimate(seen, preset=switches, known=fixed, progress=progress)
        recovery = recover(
            given or seen, None, self.method, self.preset, sharing=self.sharing, tv=self.tv,
            parameters=self.parameters, start=initial, checkpoint=place.draft / CHECKPOINT,
            resume=self.resume, checkpoint_seconds=self.checkpoint_seconds, progress=progress,
            **options,
        )  # fmt: skip
        known = recovery.estimate or given or estimate(seen, preset=model, progress=progress)
        print_prediction(progress, known)
        capture = warn_of_exposure(capture, known)
        field = None
        if supports_texture_field(known):
            field = texture_field(recovery, known, capture.mesh, progress=progress)
        with progress.stage("Writing the results"):
            run = self.run_info(progress)
            write_recovery(
                capture, recovery, place, run, estimate=known, field=field, normals=refined,
                draws=self.drawn, seed=self.seed, pictures=self.pictures,
            )  # fmt: skip
            return IntervalSummary.of(known)

    def _options(self) -> dict[str, Any]:
        """Return options for ``recover``: ``sh``, ``path`` or both, depending on the method."""
        from svu_mi.recovery.recovery_options import method_options

        for option, unused in (("steps", "path"), ("epochs", "sh")):
            if self.method == unused and getattr(self, option) is not None:
                raise OptionError(f"--{option} has no effect with --method {unused}; omit it.")
        options = method_options(self.method, self.preset)
        if (sh := options.get("sh")) and self.steps is not None:
            options["sh"] = replace(sh, descent=replace(sh.descent, steps=self.steps))
        if path := options.get("path"):
            epochs = path.epochs if self.epochs is None else self.epochs
            options["path"] = replace(path, epochs=epochs, seed=self.seed)
        return options


def _advice(checkpoint: Path) -> str:
    if checkpoint.exists():
        return "interrupted; a checkpoint is kept: continue with the same command and --resume"
    return "interrupted before the first step; run the same command again"
