"""``svu inpaint``: fill unseen texels of recovered textures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from svu_mi.cli import shared_options as opt
from svu_mi.cli.base_command import ResultCommand
from svu_mi.cli.loading import CaptureCommand
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

From = Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
Weights = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]


@dataclass(frozen=True, kw_only=True)
class Inpaint(CaptureCommand, ResultCommand):
    """Fill texels of recovered textures that no photograph shows, by what they are like.

    In their piece of the object, as high, around an axis, or on the other side of a mirror: how
    much each of these says is found out by hiding parts that were seen. With --model, a diffusion
    model invents them. Writes textures, recovered.xml, uncertainty.exr, filled.exr (1 where a texel
    was filled), filled.png and run.json.
    """

    command = "inpaint"
    light: opt.GivenLight = None
    output: opt.Output = Path("out/filled")
    recovered: From
    """Folder that svu recover wrote."""
    above: float = inf
    """Fill texels, too, of which a parameter's standard deviation is larger: what is known of them
    counts as much as it is certain. Without it, those that were never seen."""
    model: Weights = None
    """Folder with the weights of a diffusion model, which fills instead of likeness, as in Sec. 5.3
    of the paper: Marigold (intrinsics, appearance) or RGB<->X (RGB to X), as published. They do
    not come with svu_mi and have licences of their own; that of RGB<->X is for noncommercial
    research. Needs svu_mi[diffusion]."""
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
            raise OptionError("How a diffusion model is asked has no effect without --model.")

    def work(self, progress: Progress, place: Claim) -> Iterable[str]:
        """Fill, and write the results."""
        from svu_mi.geometry.neighbors import neighbors
        from svu_mi.output.texture_files import (
            read_textures,
            recovery_settings,
            require_textures_of,
        )
        from svu_mi.output.write_fill import fill_sentences, write_filled
        from svu_mi.parameters import NAMES
        from svu_mi.pipeline import estimate
        from svu_mi.recovery.uncertainty.texture_field import field_around, tv_weights

        textures, model = read_textures(self.recovered), self._load_model(progress)
        size = textures.resolution
        need = partial(Need, "recover", resolution=size, model="default")
        capture, texels = self.load_with_light(progress, need, size, self.light)
        require_textures_of(capture, self.recovered)
        known = estimate(capture, texels, whole=True, progress=progress)
        with progress.stage("How sure the textures are"):
            used, around = recovery_settings(self.recovered), neighbors(texels, capture.mesh)
            names = used.get("parameters", NAMES)
            field = field_around(textures, known, around, names, tv_weights(used))
        filled = self._fill(progress, model, capture, field, known.posterior.observed)
        with progress.stage("Writing the results"):
            run = self.run_info(progress)
            write_filled(capture, field, filled, place, run, pictures=self.pictures)
        return fill_sentences(filled)

    def _load_model(self, progress: Progress) -> LatentDiffusion | None:
        """Read the weights: before anything that takes long."""
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
