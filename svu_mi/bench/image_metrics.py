"""PSNR and SSIM of textures and relit pictures.

Similar to Stanford-ORB (Kuang et al., NeurIPS 2023, Sec. 4.2), with two differences: no scale per
channel is fitted, because the light is known; and means are over the object's pixels only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from svu_mi.bench.metric_inputs import two_pictures
from svu_mi.capture.image_io import srgb
from svu_mi.errors import ShapeError
from svu_mi.evaluation.psnr import psnr


def texture_psnr(estimate: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, float]:
    """Return the PSNR in dB of every parameter, and their mean as ``average``.

    The average is defined as in Table 2 of the paper: the mean of the PSNRs of all parameters, each
    with the same weight.

    Args:
        estimate: (T, C) or (T,) values by parameter, in [0, 1].
        truth: True values of the same parameters and shapes.
    """
    _require_same(estimate, truth)
    by_name = {name: psnr(estimate[name], truth[name]) for name in truth}
    return {**by_name, "average": float(np.mean(list(by_name.values())))}


def texel_error(estimate: Mapping[str, Any], truth: Mapping[str, Any]) -> np.ndarray:
    """Return each texel's absolute error, (T,), averaged over channels, then parameters.

    Args:
        estimate: (T, C) or (T,) values by parameter.
        truth: True values of the same parameters and shapes.
    """
    _require_same(estimate, truth)
    off = (np.abs(np.subtract(estimate[name], true, dtype=float)) for name, true in truth.items())
    return np.mean([each.reshape(len(each), -1).mean(axis=1) for each in off], axis=0)


def _require_same(estimate: Mapping[str, Any], truth: Mapping[str, Any]) -> None:
    if not truth or set(estimate) != set(truth):
        raise ShapeError(f"Parameters differ: estimate {sorted(estimate)}, truth {sorted(truth)}.")


HDR_LIMIT = 4.0  # clipping level; brighter pixels, such as a sun's highlight, would dominate
WHITE = 0.95  # quantile of the object's pixels that tone mapping maps to white
# Wang et al., Image Quality Assessment (IEEE TIP 2004), Sec. III-B.
WINDOW_SIGMA, WINDOW_RADIUS = 1.5, 5
K1, K2 = 0.01, 0.03


@dataclass(frozen=True)
class ImageError:
    """Errors of a picture compared with the true one.

    Attributes:
        psnr_hdr: PSNR in dB of linear radiance, divided by the true picture's white level and
            clipped at 4; the peak is 1.
        psnr_ldr: PSNR in dB of the tone-mapped pictures.
        ssim: Structural similarity of the tone-mapped pictures, at most 1.
    """

    psnr_hdr: float
    psnr_ldr: float
    ssim: float


def image_error(picture: Any, truth: Any, mask: Any) -> ImageError:
    """Compare two pictures on the object.

    Args:
        picture: (H, W, 3) linear radiance.
        truth: (H, W, 3) true linear radiance.
        mask: (H, W) bool, pixels of the object.
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
        truth: (H, W, C) in [0, 1].
        radius: Window radius in pixels.
        border: Border mode of ``scipy.ndimage``.
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
