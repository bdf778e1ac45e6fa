"""One recovery against the true textures, and pictures of it against those of the true ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from svu_mi import metrics
from svu_mi.bench.captures import Truth, some_views
from svu_mi.bench.cases import Cell
from svu_mi.capture import Capture
from svu_mi.capture.rendering import object_mask
from svu_mi.capture.scene import find_shape, load_scene
from svu_mi.errors import CaptureError
from svu_mi.metrics import image_error
from svu_mi.pipeline import estimate
from svu_mi.recovery.relight import relight
from svu_mi.recovery.textures import Textures
from svu_mi.surface import Texels


@dataclass(frozen=True)
class Judge:
    """What is known of a cell before anything is recovered.

    Attributes:
        truth: of T texels.
        coverage: (T,) number of views that see each texel.
        entropy: (T,) angular entropy, of the default preset.
        poor: most views of a texel that counts as hardly seen.
    """

    truth: Truth
    coverage: np.ndarray
    entropy: np.ndarray
    poor: int

    @classmethod
    def of(cls, capture: Capture, grid: Texels, poor: int) -> Judge:
        """Look the truth up, and estimate the entropy.

        Raises:
            SceneError: the scene does not know the true parameters.
            CaptureError: no texel is seen.
        """
        truth, found = Truth.of(capture, grid), estimate(capture, grid)
        coverage = np.array(found.coverage)
        if not (coverage > 0).any():
            raise CaptureError("No texel is seen in any photograph; there is nothing to compare.")
        return cls(
            truth=truth,
            coverage=coverage,
            entropy=np.array(found.entropy, np.float64),
            poor=poor,
        )

    def figures(self) -> dict[str, Any]:
        """Return counts of texels: all, seen, hardly seen."""
        seen = self.coverage > 0
        return {
            "texels": self.truth.grid.count,
            "seen": int(seen.sum()),
            "hardly_seen": int((seen & (self.coverage <= self.poor)).sum()),
            "mean_entropy": float(self.entropy[seen].mean()),
        }

    def judge(self, textures: Textures) -> dict[str, Any]:
        """Return ``psnr`` of seen texels, ``psnr_hardly_seen`` (None if there are none), and
        ``entropy_correlation``, Pearson's of a texel's mean absolute error with its entropy.
        """
        seen = self.coverage > 0
        hardly = seen & (self.coverage <= self.poor)
        error = self.truth.error(textures, seen)
        return {
            "psnr": self.truth.psnr(textures, seen),
            "psnr_hardly_seen": self.truth.psnr(textures, hardly) if hardly.any() else None,
            "entropy_correlation": metrics.pearson(error, self.entropy[seen]),
        }


@dataclass(frozen=True)
class Relit:
    """The true pictures, and what is needed to make them with other textures.

    Attributes:
        capture: the object under the other light, with the sensors of the pictures.
        truth: their radiance, (H, W, 3) each.
        masks: (H, W) bool, pixels that lie on the object entirely.
        spp: samples per pixel.
        seed: of the first picture.
    """

    capture: Capture
    truth: Sequence[np.ndarray]
    masks: Sequence[np.ndarray]
    spp: int
    seed: int

    @classmethod
    def of(cls, capture: Capture, cell: Cell, count: int, spp: int, seed: int = 0) -> Relit:
        """Render the true pictures.

        Args:
            capture: sensors of the pictures are some of its own.
            cell: the same object under another light.
            count: number of pictures.
            spp: samples per pixel.
            seed: of the first; pictures of other textures use the same, so that most of the
                noise cancels.

        Raises:
            SceneError: the other scene cannot be loaded.
        """
        scene = load_scene(cell.scene, cell.defines)
        shape = find_shape(scene, capture.shape.id(), str(cell.scene))
        other = replace(some_views(capture, count), scene=scene, shape=shape, mesh=shape)
        masks = [object_mask(scene, shape, sensor) >= 1 for sensor in other.sensors]
        found = cls(other, (), masks, spp, seed)
        return replace(found, truth=found.pictures(None))

    def pictures(self, textures: Textures | None) -> list[np.ndarray]:
        """Render the object with these textures instead of its own; None for its own."""
        return relight(self.capture, textures, spp=self.spp, seed=self.seed)

    def judge(self, textures: Textures) -> dict[str, float]:
        """Return psnr_hdr, psnr_ldr and ssim, means over the pictures (``image_error``)."""
        found = [
            asdict(image_error(picture, true, mask))
            for picture, true, mask in zip(
                self.pictures(textures), self.truth, self.masks, strict=True
            )
            if mask.any()
        ]
        return {name: float(np.mean([one[name] for one in found])) for name in found[0]}
