"""``svu inpaint``: fill unseen texels of recovered textures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from svu_mi.cli import shared_options as opt
from svu_mi.cli.base_command import ResultCommand
from svu_mi.cli.loading import LitCommand, print_prediction
from svu_mi.core.io.output_folder import Claim
from svu_mi.core.memory import Need
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.recovery.inpaint.diffusion.model_interface import DiffusionOptions

if TYPE_CHECKING:
    import numpy as np

    from svu_mi.capture.capture import Capture
    from svu_mi.recovery.inpaint.diffusion.latent_diffusion import LatentDiffusion
    from svu_mi.recovery.inpaint.fill_result import Filled
    from svu_mi.recovery.uncertainty.texture_field import TextureField

From = Annotated[Path, arg(metavar="FOLDER")]
Weights = Annotated[Path | None, arg(metavar="FOLDER")]


@dataclass(frozen=True, kw_only=True)
class Inpaint(LitCommand, ResultCommand):
    """Fill unseen texels of recovered textures.

    Predicts them from similar texels (same part, height or symmetric position; weighted by
    cross-validation on seen texels), or by a diffusion model. Writes textures, recovered.xml,
    uncertainty.exr, filled.exr (1 at filled texels), filled.png and run.json.
    """

    command = "inpaint"
    first = "scene recovered output above model light images shape overwrite"
    output: opt.Output = Path("out/filled")
    recovered: From
    """Folder written by svu recover for the same capture."""
    above: float = inf
    """Also fill seen texels where a parameter has a larger standard deviation than this positive
    number, such as 0.2; inf: fill unseen texels only."""
    model: Weights = None
    """Folder of published weights of Marigold (intrinsics, appearance) or RGB<->X, which have their
    own licences; needs svu_mi[diffusion] (default: similar texels)."""
    pictures: opt.Pictures = True
    diffusion: DiffusionOptions = DiffusionOptions()

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        super().check()
        if not self.above > 0:
            raise OptionError(f"--above must be positive, got {self.above}.")
        if self.model is not None:
            from svu_mi.recovery.inpaint.diffusion.load_weights import require_model

            require_model(self.model)
        elif self.diffusion != DiffusionOptions():
            raise OptionError(
                "Options of the diffusion model have no effect without --model; omit them."
            )

    def work(self, progress: Progress, place: Claim) -> Iterable[str]:
        """Fill, and write the results."""
        from svu_mi.geometry.neighbors import neighbors
        from svu_mi.output.texture_files import (
            capture_of_textures,
            read_textures,
            recovery_settings,
        )
        from svu_mi.output.write_fill import fill_sentences, write_filled
        from svu_mi.parameters import NAMES
        from svu_mi.pipeline import estimate
        from svu_mi.recovery.uncertainty.texture_field import field_around, tv_weights

        textures, model = read_textures(self.recovered), self._load_model(progress)
        size = textures.resolution
        need = partial(Need, "inpaint", resolution=size, model="default")
        capture, texels = self.load_with_light(progress, need, size)
        capture = capture_of_textures(capture, self.recovered)
        known = estimate(capture, texels, whole=True, progress=progress)
        print_prediction(progress, known)
        with progress.stage("Estimating the uncertainty of textures"):
            used, around = recovery_settings(self.recovered), neighbors(texels, capture.mesh)
            names = used.get("parameters", NAMES)
            field = field_around(textures, known, around, names, tv_weights(used))
        filled = self._fill(progress, model, capture, field, known.posterior.observed)
        with progress.stage("Writing the results"):
            run = self.run_info(progress)
            write_filled(capture, field, filled, place, run, pictures=self.pictures)
        return fill_sentences(filled)

    def _load_model(self, progress: Progress) -> LatentDiffusion | None:
        """Read the weights of the diffusion model, before any long work."""
        if self.model is None:
            return None
        from svu_mi.recovery.inpaint.diffusion.load_weights import load_model

        with progress.stage("Reading the model"):
            return load_model(self.model, self.diffusion.device)

    def _fill(
        self, progress: Progress, model: LatentDiffusion | None, capture: Capture,
        field: TextureField, seen: np.ndarray,
    ) -> Filled:  # fmt: skip
        if model is None:
            from svu_mi.recovery.inpaint.fill import fill

            return fill(field, seen, self.above, progress=progress)
        from svu_mi.recovery.inpaint.diffusion.fill_by_diffusion import fill_by_diffusion

        return fill_by_diffusion(
            capture, field, seen, model, self.above, self.diffusion, progress=progress
        )
