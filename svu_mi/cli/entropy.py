"""``svu entropy``: entropy of each texel."""

from dataclasses import dataclass
from pathlib import Path

from svu_mi.cli import shared_options as opt
from svu_mi.cli.base_command import ResultCommand
from svu_mi.cli.loading import EstimateCommand
from svu_mi.core.io.output_folder import Claim
from svu_mi.core.progress import Progress


@dataclass(frozen=True, kw_only=True)
class Entropy(EstimateCommand, ResultCommand):
    """Compute the entropy of each texel: how uncertain its material is.

    Writes entropy.exr (0: certain, 1: as uncertain as the prior), coverage.exr (number of views
    per texel), overview.png and run.json.
    """

    command = "entropy"
    first = "scene output resolution light images render preset method known overwrite"
    output: opt.Output = Path("out/entropy")
    resolution: opt.Resolution = (512,)
    skip: bool = True
    """Skip work that does not change results, such as unseen texels; --no-skip to verify that."""
    pictures: opt.Pictures = True

    def work(self, progress: Progress, place: Claim) -> list[str]:
        """Run the pipeline, write the four files, and return a summary."""
        from svu_mi.calibration.checks.exposure_checks import warn_of_exposure
        from svu_mi.output.write_entropy import write_outputs
        from svu_mi.presets import NOTHING, Skip

        size, skip = opt.parse_resolution(self.resolution), Skip() if self.skip else NOTHING
        capture, result = self.load_and_estimate(progress, size, "entropy", skip=skip)
        capture = warn_of_exposure(capture, result)
        with progress.stage("Writing the results"):
            run = self.run_info(progress)
            summary = write_outputs(capture, result, place, run, pictures=self.pictures)
        return [summary.summary()]
