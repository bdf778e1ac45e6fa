"""Pictures of the object under a light that was not used for recovery."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from svu_mi.bench.captures import some_views
from svu_mi.bench.cells import Cell
from svu_mi.capture import Capture
from svu_mi.capture.rendering import object_mask
from svu_mi.capture.scene import find_shape, load_scene
from svu_mi.metrics import image_error
from svu_mi.recovery.relight import relight
from svu_mi.recovery.textures import Textures


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
