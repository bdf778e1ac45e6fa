"""An estimate at the texels that a picture of it shows.

A page shows a texture of 512 x 512 texels in half as many pixels. What is computed for pictures
alone, most probable parameters and intervals, is computed for what they show.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.pipeline import Estimate
from svu_mi.posterior.part import PartOfPosterior
from svu_mi.surface import Texels


@dataclass(frozen=True)
class Thinned:
    """Some texels of an estimate, as those of a smaller texture.

    Attributes:
        estimate: of t texels, laid out in the smaller texture; the whole one if that is as small.
        chosen: (t,) int64, which of all texels they are.
    """

    estimate: Estimate
    chosen: np.ndarray

    @staticmethod
    def of(estimate: Estimate, side: int) -> Thinned:
        """Take one texel for every pixel of a picture of the texture.

        Args:
            estimate: of all texels.
            side: of the picture's longer side, in pixels.
        """
        texels = estimate.texels
        large = np.array(texels.resolution)
        small = np.maximum(large * side // large.max(), 1)
        if (small >= large).all():
            return Thinned(estimate, np.arange(texels.count))
        columns, rows = (_middles(*sizes) for sizes in zip(small, large, strict=True))
        place = np.full(large[1] * large[0], -1)
        place[texels.index.numpy()] = np.arange(texels.count)
        shown = place.reshape(large[1], large[0])[np.ix_(rows, columns)].ravel()
        # Texels stay in their order, in which neighbours are near each other.
        pixels = np.flatnonzero(shown >= 0)
        pixels = pixels[np.argsort(shown[pixels], kind="stable")]
        chosen = shown[pixels]
        width, height = (int(size) for size in small)
        return Thinned(_some(estimate, chosen, pixels, (width, height)), chosen)


def _middles(small: int, large: int) -> np.ndarray:
    """Which of so many texels is in the middle of each of fewer pixels."""
    return ((np.arange(small) + 0.5) * large / small).astype(np.int64)


def _some(
    estimate: Estimate, chosen: np.ndarray, pixels: np.ndarray, resolution: tuple[int, int]
) -> Estimate:
    lanes = owned(mi.UInt32, chosen.astype(np.uint32))
    return replace(
        estimate,
        texels=_laid_out(estimate.texels, lanes, pixels, resolution),
        posterior=PartOfPosterior.of(estimate.posterior, chosen),
        coverage=dr.gather(mi.UInt32, mi.UInt32(estimate.coverage), lanes),
    )


def _laid_out(
    texels: Texels, lanes: Any, pixels: np.ndarray, resolution: tuple[int, int]
) -> Texels:
    def take(values: Any) -> Any:
        return dr.gather(type(values), values, lanes)

    some: dict[str, Any] = {name: take(getattr(texels, name)) for name in (
        "face", "position", "normal", "geometric_normal", "uv", "footprint",
    )}  # fmt: skip
    sides = (take(texels.sides[0]), take(texels.sides[1]))
    return replace(
        texels, resolution=resolution, index=owned(mi.UInt32, pixels.astype(np.uint32)),
        sides=sides, **some,
    )  # fmt: skip
