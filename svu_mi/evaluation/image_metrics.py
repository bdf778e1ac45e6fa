"""PSNR and SSIM of textures and relit pictures.

Much as Stanford-ORB does it (Kuang et al., NeurIPS 2023, Sec. 4.2), but no scale per channel is
fitted, since the light is known and the scale is part of the error; and means are over the
object's pixels, not the whole picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from svu_mi.capture.image_io import srgb
from svu_mi.errors import ShapeError
from svu_mi.evaluation.metric_inputs import require_finite, two_pictures

CEILING_DB = 100.0  # of a PSNR: that of an RMS error of 1e-5, and of none at all


def psnr(estimate: Any, truth: Any) -> float:
    """Return the peak signal-to-noise ratio 10 log10(1 / MSE), in dB, at most 100.

    Args:
        estimate: estimate, any shape.
        truth: of the same shape.
    """
    a, b = np.array(estimate, np.float64), np.array(truth, np.float64)
    if a.shape != b.shape or a.size == 0:
        raise ShapeError(
            f"psnr() needs two arrays of one shape with values, got {a.shape} and {b.shape}."
        )
    require_finite(a, "the estimate")
    require_finite(b, "the truth")
    mean_square = float(np.mean((a - b) ** 2))
    return min(CEILING_DB, -10 * float(np.log10(max(mean_square, 1e-30))))


def texture_psnr(estimate: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, float]:
    """Return the PSNR of every parameter, and their mean as ``average``.

    The average of Table 2 of the paper: a mean of decibels over parameters, each of which
    counts the same whatever its number of channels.

    Args:
        estimate: (T, C) or (T,) by parameter, in [0, 1].
        truth: the same.
    """
    _require_same(estimate, truth)
    by_name = {name: psnr(estimate[name], truth[name]) for name in truth}
    return {**by_name, "average": float(np.mean(list(by_name.values())))}


def texel_error(estimate: Mapping[str, Any], truth: Mapping[str, Any]) -> np.ndarray:
    """Return (T,) mean absolute errors: over channels, then over parameters.

    Args:
        estimate: (T, C) or (T,) by parameter.
        truth: the same.
    """
    _require_same(estimate, truth)
    off = (np.abs(np.subtract(estimate[name], true, dtype=float)) for name, true in truth.items())
    return np.mean([each.reshape(len(each), -1).mean(axis=1) for each in off], axis=0)


def _require_same(estimate: Mapping[str, Any], truth: Mapping[str, Any]) -> None:
    if not truth or set(estimate) != set(truth):
        raise ShapeError(f"Parameters differ: found {sorted(estimate)}, true {sorted(truth)}.")


HDR_LIMIT = 4.0  # brighter pixels, such as a sun's highlight, would be all that counts
WHITE = 0.95  # part of the object's pixels that are not clipped in the tone-mapped picture
# Wang et al., Image Quality Assessment (IEEE TIP 2004), Sec. III-B.
WINDOW_SIGMA, WINDOW_RADIUS = 1.5, 5
K1, K2 = 0.01, 0.03


@dataclass(frozen=True)
class ImageError:
    """One picture against the true one.

    Attributes:
        psnr_hdr: dB, of linear radiance in units of the true picture's white, clipped at 4;
            the peak is 1.
        psnr_ldr: dB, of the tone-mapped pictures.
        ssim: structural similarity of the tone-mapped pictures, at most 1.
    """

    psnr_hdr: float
    psnr_ldr: float
    ssim: float


def image_error(picture: Any, truth: Any, mask: Any) -> ImageError:
    """Compare two pictures on the object.

    Args:
        picture: (H, W, 3) linear radiance.
        truth: the same.
        mask: (H, W) bool, the object's pixels.
    """
    inside = np.array(mask, bool)
    a, b = two_pictures(picture, truth, inside)
    white = float(np.quantile(b[inside].max(axis=-1), WHITE)) or 1.0
    a, b = (np.where(inside[..., None], np.clip(x / white, 0, HDR_LIMIT), 0) for x in (a, b))
    low_a, low_b = srgb(np.clip(a, 0, 1)), srgb(np.clip(b, 0, 1))
    return ImageError(
        psnr_hdr=psnr(a[inside], b[inside]),
        psnr_ldr=psnr(low_a[inside], low_b[inside]),
        ssim=float(ssim_map(low_a, low_b)[inside].mean()),
    )


def ssim_map(
    picture: np.ndarray, truth: np.ndarray, radius: int = WINDOW_RADIUS, border: str = "reflect"
) -> np.ndarray:
    """Return the SSIM index of every pixel and channel (Wang et al. 2004, Eq. 13).

    Args:
        picture: (H, W, C) in [0, 1].
        truth: the same.
        radius: pixels of the window on each side of its centre.
        border: what lies beyond the picture, as ``scipy.ndimage`` calls it.
    """

    def local(values: np.ndarray) -> np.ndarray:
        sigma = (WINDOW_SIGMA, WINDOW_SIGMA, 0)
        return scipy.ndimage.gaussian_filter(values, sigma, radius=(radius, radius, 0), mode=border)

    c1, c2 = K1**2, K2**2
    mean_a, mean_b = local(picture), local(truth)
    variance = local(picture**2) - mean_a**2 + local(truth**2) - mean_b**2
    covariance = local(picture * truth) - mean_a * mean_b
    alike = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return alike / ((mean_a**2 + mean_b**2 + c1) * (variance + c2))
