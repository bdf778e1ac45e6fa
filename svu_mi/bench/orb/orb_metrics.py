"""Image errors by the rules of Stanford-ORB.

Kuang et al., Stanford-ORB: A Real-World 3D Object Inverse Rendering Benchmark (NeurIPS 2023),
Sec. 4.2. Details that it does not specify follow the authors' code (orb/utils/test.py,
evaluation.py):

* The mask is eroded by 5 x 5 pixels. Pixels outside are set to black, and are included.
* Relighting: each channel of the picture is scaled to the photograph by least squares over the
  mask, because the scale of a reflectance is unknown. New views: no scale.
* PSNR-H: radiance, clipped at 4, after one gain for both pictures that maps the mean of the
  photograph to the mean of its tone-mapped version. PSNR-L: clipped at 1, then sRGB. The peak is
  1. PSNR is at least the PSNR of a uniform grey of 0.5.
* SSIM: tone-mapped pictures, windows of 3 x 3 pixels.
* LPIPS: VGG-16, tone-mapped pictures with sRGB applied once more, as in the authors' code.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion

from svu_mi.bench.image_metrics import ssim_map
from svu_mi.bench.metric_inputs import two_pictures
from svu_mi.capture.image_io import srgb
from svu_mi.errors import SvuWarning
from svu_mi.evaluation.psnr import psnr

ERODED = 5  # side in pixels of the square that erodes the mask
HDR_LIMIT = 4.0  # clipping value of normalised radiance
GREY = 0.5  # uniform picture with the least PSNR
DARK = 1e-6  # largest sum of squares of a black channel, which is not scaled


@dataclass(frozen=True)
class OrbError:
    """Errors of a picture.

    Attributes:
        psnr_hdr: PSNR of radiance in dB; None for albedo.
        psnr_ldr: PSNR of tone-mapped values in dB.
        ssim: Structural similarity, at most 1.
        lpips: Perceptual distance; None if unavailable.
    """

    psnr_hdr: float | None
    psnr_ldr: float
    ssim: float
    lpips: float | None


def orb_error(picture: Any, truth: Any, mask: Any, *, scaled: bool) -> OrbError:
    """Compare a picture with a photograph.

    Args:
        picture: Linear radiance, not negative, (H, W, 3).
        truth: Linear radiance of the photograph, (H, W, 3); negative values count as 0.
        mask: Pixels of the object, not eroded, (H, W) bool.
        scaled: Fit a scale per channel (relighting).

    Raises:
        ShapeError: The shapes differ, or the eroded mask is empty.
        OptionError: NaN or infinite values on the object.
    """
    a, b, inside = _prepared(picture, truth, mask)
    scale = channel_scale(a[inside], b[inside]) if scaled else np.ones(3)
    white = np.clip(b, 0, 1).mean()
    gain = srgb(np.clip(b, 0, 1)).mean() / white if white > 1e-8 else 1.0
    # The scale does not depend on the gain, which multiplies both pictures.
    high_a, high_b = (np.clip(gain * x, 0, HDR_LIMIT) for x in (scale * a, b))
    low_a, low_b = (srgb(np.clip(x, 0, 1)) for x in (scale * a, b))
    return OrbError(
        psnr_hdr=_psnr(high_a, high_b, inside),
        psnr_ldr=_psnr(low_a, low_b, inside),
        ssim=_ssim(low_a, low_b),
        lpips=lpips(srgb(low_a), srgb(low_b)),
    )


def orb_albedo_error(picture: Any, truth: Any, mask: Any) -> OrbError:
    """Compare a picture of the base colour with the base colour of the data set.

    Channels are scaled as for relighting; PSNR-L and SSIM compare linear values.

    Args:
        picture: Linear values, (H, W, 3).
        truth: Linear values of the data set, (H, W, 3).
        mask: Pixels of the object, (H, W) bool.

    Raises:
        ShapeError: The shapes differ, or the eroded mask is empty.
        OptionError: NaN or infinite values on the object.
    """
    a, b, inside = _prepared(picture, truth, mask)
    a, b = np.clip(channel_scale(a[inside], b[inside]) * a, 0, 1), np.clip(b, 0, 1)
    return OrbError(
        psnr_hdr=None, psnr_ldr=_psnr(a, b, inside), ssim=_ssim(a, b), lpips=lpips(srgb(a), srgb(b))
    )


def channel_scale(picture: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the factors (3,) that fit the channels of a picture to a photograph.

    Args:
        picture: Radiance of the object's pixels, (N, 3).
        truth: Radiance of the photograph, (N, 3).
    """
    energy = (picture**2).sum(axis=0)
    black = energy <= DARK
    picture, energy = np.where(black, 1.0, picture), np.where(black, len(picture), energy)
    return (picture * truth).sum(axis=0) / energy


def _prepared(picture: Any, truth: Any, mask: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return both pictures, black outside the eroded mask, and the eroded mask."""
    # The border of the picture does not erode the mask, because the object may extend beyond.
    inside = binary_erosion(np.array(mask, bool), np.ones((ERODED, ERODED)), border_value=1)
    a, b = two_pictures(picture, truth, inside)
    a, b = (np.where(inside[..., None], np.maximum(x, 0), 0) for x in (a, b))
    return a, b, inside


def _psnr(a: np.ndarray, b: np.ndarray, inside: np.ndarray) -> float:
    grey = np.where(inside[..., None], GREY, 0) * np.ones(3)
    return max(psnr(a, b), psnr(grey, b))


def _ssim(a: np.ndarray, b: np.ndarray) -> float:
    return float(ssim_map(a, b, radius=1, border="mirror").mean())


def lpips(picture: np.ndarray, truth: np.ndarray) -> float | None:
    """Return the LPIPS distance (Zhang et al., CVPR 2018) by VGG-16, 0 for equal pictures.

    Args:
        picture: Tone-mapped values in [0, 1], (H, W, 3).
        truth: Tone-mapped values of the photograph, (H, W, 3).

    Returns:
        The distance; None without the package (``pip install lpips``), or without the weights of
        VGG-16, which the package downloads on first use.
    """
    network = _network()
    if network is None:
        return None
    import torch

    with torch.no_grad():
        a, b = (
            torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32))
            for image in (picture, truth)
        )
        return float(network(a, b, normalize=True).item())


@cache
def _network() -> Any:
    """Return VGG-16, loaded once; None without the package, or, with a warning, without weights."""
    try:
        from lpips import LPIPS
    except ImportError:
        return None
    try:
        return LPIPS(net="vgg", verbose=False).eval()
    except (OSError, RuntimeError) as error:  # the weights are downloaded, then unpacked
        warnings.warn(
            f"LPIPS is skipped: the weights of VGG-16 cannot be loaded ({error}).", SvuWarning,
            stacklevel=2,
        )  # fmt: skip
        return None
