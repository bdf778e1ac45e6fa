"""``svu bench recovery``: recovered textures, compared with the true ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.bench.captures import TrueTextures, even_views
from svu_mi.bench.cases import Case, chosen_cases
from svu_mi.bench.correlation import pearson
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Record
from svu_mi.bench.image_metrics import image_error
from svu_mi.bench.problem_sizes import RecoverySizes
from svu_mi.bench.recovery.methods import RecoveryMethod, choose_methods
from svu_mi.bench.recovery.recovery_tables import draw_recovery, find_bars, recovery_tables
from svu_mi.bench.study import Selection, Study
from svu_mi.bench.timing import Timed, time_warm
from svu_mi.capture.capture import Capture
from svu_mi.capture.rendering import object_mask
from svu_mi.capture.scene import load_scene
from svu_mi.capture.target import find_target
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError, OptionError
from svu_mi.geometry.texels import Texels
from svu_mi.pipeline import estimate
from svu_mi.recovery.relighting import relight
from svu_mi.recovery.svbrdf_textures import Textures, lay_out

BRIEF = 4  # number of steps in which all kernels are compiled


@dataclass(frozen=True)
class RecoveryCase(CaseSubject):
    """A case whose textures are recovered.

    Attributes:
        relit_as: Returns the same object under a light that is not used for recovery.
        rows: Recovery methods.
    """

    relit_as: Callable[[], Case]
    rows: Sequence[RecoveryMethod]

    @property
    def sizes(self) -> RecoverySizes:
        """Sizes of the recovery benchmark."""
        return self.bench.sizes.recovery

    def settings(self, row: RecoveryMethod | None) -> Any:
        cases = [(str(one.scene), one.defines) for one in (self.case, self.other)]
        size = self.bench.sizes
        photographs = (size.views, size.film, size.spp, size.texels, size.seed)
        return cases, photographs, asdict(self.sizes), row and asdict(row)

    def head(self) -> Record:
        """Return names, counts, and relighting errors of the true textures."""
        return {
            "object": self.case.object, "light": self.case.light, "relit": self.other.light,
            "views": self.capture.count, **self.scorer.counts(),
            "truth_relit": self.relit.score(lay_out(self.layout, self.scorer.truth.values)),
        }  # fmt: skip

    def measure(self, row: RecoveryMethod) -> Record:
        """Return times, errors of textures and errors of relit pictures."""
        timed = recover_warm(row, self.capture, self.layout, self.sizes)
        textures = timed.result.textures
        relit = self.relit.score(textures)
        return {**run_figures(timed), **self.scorer.score(textures), "relit": relit}

    @cached_property
    def other(self) -> Case:
        """Same object under another light."""
        return self.relit_as()

    @cached_property
    def capture(self) -> Capture:
        """Photographs of the case."""
        whole = self.bench.capture(self.case)
        return even_views(whole, min(self.sizes.even_views, whole.count))

    @cached_property
    def scorer(self) -> TextureScorer:
        """Scores of textures."""
        return TextureScorer.of(self.capture, self.layout, self.sizes.poor)

    @cached_property
    def relit(self) -> RelightingScorer:
        """Scores of pictures under the other light."""
        sizes = self.sizes
        return RelightingScorer.of(self.capture, self.other, sizes.relit_views, sizes.relit_spp)


def next_light_case(case: Case, data: Path | None, workspace: Path) -> Case:
    """Return the same object under the next light.

    Args:
        case: Object and light.
        data: Folder of the case; None for the scenes of svu_mi.
        workspace: Folder for converted objects.

    Raises:
        OptionError: There is only one light.
    """
    around = chosen_cases(data, workspace, [case.object])
    lights = [one.light for one in around]
    if len(lights) < 2:
        raise OptionError(
            f"{case.title}: relighting needs a second light; add another image to envmaps/."
        )
    return around[(lights.index(case.light) + 1) % len(lights)]


def recover_warm(
    row: RecoveryMethod, capture: Capture, grid: Texels, sizes: RecoverySizes
) -> Timed:
    """Recover textures with compiled kernels.

    A short run compiles the kernels first. A row that takes longer than ``sizes.long_s`` is timed
    once.
    """
    run = partial(row.recover, capture, grid, sizes.scale)
    if not sizes.warm:
        return time_warm(run, sizes.repeats, long_s=0)
    row.recover_in(BRIEF, capture, grid, Progress())
    return time_warm(run, sizes.repeats, sizes.long_s)


def run_figures(timed: Timed) -> Record:
    """Return times and step counts of a result of ``recover_warm``."""
    return {
        "seconds": timed.seconds,
        "runs": timed.runs,
        "compiled": timed.compiled,
        "steps": len(timed.result.losses),
        "timings": timed.timings,
    }


@dataclass(frozen=True)
class TextureScorer:
    """Scores of recovered textures against the true ones.

    Attributes:
        truth: True textures of T texels.
        coverage: Number of views of each texel, (T,).
        entropy: Angular entropy of the preset ``default``, (T,).
        poor: Largest number of views for which a texel counts as hardly seen.
    """

    truth: TrueTextures
    coverage: np.ndarray
    entropy: np.ndarray
    poor: int

    @classmethod
    def of(cls, capture: Capture, grid: Texels, poor: int) -> TextureScorer:
        """Evaluate the true textures and estimate the entropy.

        Raises:
            SceneError: The material of the scene is not ``principled``.
            CaptureError: No texel is visible.
        """
        truth, estimated = TrueTextures.of(capture, grid), estimate(capture, grid)
        coverage = np.array(estimated.coverage)
        if not (coverage > 0).any():
            raise CaptureError(
                "No texel is visible in any photograph, so textures cannot be compared."
            )
        return cls(
            truth=truth,
            coverage=coverage,
            entropy=np.array(estimated.entropy, np.float64),
            poor=poor,
        )

    def counts(self) -> dict[str, Any]:
        """Return numbers of all, visible and hardly seen texels, and the mean entropy."""
        seen = self.coverage > 0
        return {
            "texels": self.truth.grid.count,
            "seen": int(seen.sum()),
            "hardly_seen": int((seen & (self.coverage <= self.poor)).sum()),
            "mean_entropy": float(self.entropy[seen].mean()),
        }

    def score(self, textures: Textures) -> dict[str, Any]:
        """Return errors of textures.

        Returns:
            ``psnr`` of visible texels; ``psnr_hardly_seen``, None without such texels;
            ``entropy_correlation``, Pearson's correlation of mean absolute error and entropy.
        """
        seen = self.coverage > 0
        hardly = seen & (self.coverage <= self.poor)
        error = self.truth.error(textures, seen)
        return {
            "psnr": self.truth.psnr(textures, seen),
            "psnr_hardly_seen": self.truth.psnr(textures, hardly) if hardly.any() else None,
            "entropy_correlation": pearson(error, self.entropy[seen]),
        }


@dataclass(frozen=True)
class RelightingScorer:
    """Errors of relit pictures.

    Attributes:
        capture: Object under the other light, with the sensors of the pictures.
        truth: Radiance of the true pictures, (H, W, 3) each.
        masks: Pixels that are completely on the object, (H, W) bool each.
        spp: Samples per pixel.
        seed: Seed of the first picture.
    """

    capture: Capture
    truth: Sequence[np.ndarray]
    masks: Sequence[np.ndarray]
    spp: int
    seed: int

    @classmethod
    def of(
        cls, capture: Capture, case: Case, count: int, spp: int, seed: int = 0
    ) -> RelightingScorer:
        """Render the true pictures.

        Args:
            capture: Capture whose sensors are used.
            case: Same object under another light.
            count: Number of pictures.
            spp: Samples per pixel.
            seed: Seed of the first picture. Pictures of other textures use the same seeds, so
                that most of the noise cancels.

        Raises:
            SceneError: The other scene cannot be loaded.
        """
        scene = load_scene(case.scene, case.defines)
        shape = find_target(scene, capture.shape.id(), str(case.scene)).mesh
        other = replace(even_views(capture, count), scene=scene, shape=shape, mesh=shape)
        masks = [object_mask(scene, shape, sensor) >= 1 for sensor in other.sensors]
        relit = cls(other, (), masks, spp, seed)
        return replace(relit, truth=relit.pictures(None))

    def pictures(self, textures: Textures | None) -> list[np.ndarray]:
        """Render the object with given textures, or with the true ones for None."""
        return relight(self.capture, textures, spp=self.spp, seed=self.seed)

    def score(self, textures: Textures) -> dict[str, float]:
        """Return psnr_hdr, psnr_ldr and ssim (``image_error``), means over the pictures."""
        errors = [
            asdict(image_error(picture, true, mask))
            for picture, true, mask in zip(
                self.pictures(textures), self.truth, self.masks, strict=True
            )
            if mask.any()
        ]
        return {name: float(np.mean([one[name] for one in errors])) for name in errors[0]}


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    sizes = bench.sizes.recovery
    rows = choose_methods(selection.rows or sizes.rows)
    subjects = (
        RecoveryCase(
            bench, case, partial(next_light_case, case, selection.data, bench.folder), rows
        )
        for case in selection.cases[: sizes.even_cells]
    )
    return Experiment("recovery", subjects)


STUDY = Study(
    title="Recovery of textures", experiment=_experiment, tables=recovery_tables, bars=find_bars,
    note="PSNR: mean over all cases with both rows. Times: median of the ratios over cases.",
    plots={"recovery": draw_recovery},
)  # fmt: skip
