"""Image errors by the rules of Stanford-ORB.

Kuang et al., Stanford-ORB: A Real-World 3D Object Inverse Rendering Benchmark (NeurIPS 2023),
Sec. 4.2; where the text leaves a choice, as in their program (orb/utils/test.py, evaluation.py):

* The mask is eroded by 5 x 5 pixels; outside, both pictures are black, and count.
* Relighting: each channel of the picture is scaled to the photograph by least squares over the
  mask, since the scale of a reflectance is not known. New views: no scale.
* PSNR-H: of radiance, both divided by one number that brings the photograph's mean to that of
  its tone-mapped self, clipped at 4. PSNR-L: clipped at 1, then sRGB. The peak is 1, and no PSNR
  is below that of a uniform grey of 0.5.
* SSIM: of the tone-mapped pictures, with windows of 3 x 3 pixels.
* LPIPS: by VGG-16, of the tone-mapped pictures with sRGB applied once more, as their program does.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion

from svu_mi.capture.image_io import srgb
from svu_mi.errors import SvuWarning
from svu_mi.evaluation.image_metrics import psnr, ssim_map
from svu_mi.evaluation.metric_inputs import two_pictures

ERODED = 5  # pixels per side of the square the mask is eroded by
HDR_LIMIT = 4.0  # of radiance, after normalisation
GREY = 0.5  # no picture counts as worse than this one
DARK = 1e-6  # sum of squares up to which a channel is black, and has no scale


@dataclass(frozen=True)
class OrbError:
    """One picture against its photograph.

    Attributes:
        psnr_hdr: dB; None for albedo, which is at most 1.
        psnr_ldr: dB.
        ssim: structural similarity, at most 1.
        lpips: perceptual distance; None where it cannot be computed.
    """

    psnr_hdr: float | None
    psnr_ldr: float
    ssim: float
    lpips: float | None


def orb_error(picture: Any, truth: Any, mask: Any, *, scaled: bool) -> OrbError:
    """Compare a picture with a photograph.

    Args:
        picture: (H, W, 3) linear radiance, not negative.
        truth: the same; what is negative counts as 0.
        mask: (H, W) bool, the object's pixels, not eroded.
        scaled: whether a scale per channel is fitted: for relighting, not for new views.

    Raises:
        ShapeError: the shapes differ, or nothing is left of the mask.
        OptionError: NaN or infinite values on the object.
    """
    a, b, inside = _prepared(picture, truth, mask)
    scale = channel_scale(a[inside], b[inside]) if scaled else np.ones(3)
    white = np.clip(b, 0, 1).mean()
    gain = srgb(np.clip(b, 0, 1)).mean() / white if white > 1e-8 else 1.0
    # The scale does not depend on the gain: both pictures are multiplied by it.
    high_a, high_b = (np.clip(gain * x, 0, HDR_LIMIT) for x in (scale * a, b))
    low_a, low_b = (srgb(np.clip(x, 0, 1)) for x in (scale * a, b))
    return OrbError(
        psnr_hdr=_psnr(high_a, high_b, inside),
        psnr_ldr=_psnr(low_a, low_b, inside),
        ssim=_ssim(low_a, low_b),
        lpips=lpips(srgb(low_a), srgb(low_b)),
    )


def orb_albedo_error(picture: Any, truth: Any, mask: Any) -> OrbError:
    """Compare a picture of the base colour with that of the data set.

    Channels are scaled as for relighting; PSNR-L and SSIM are of linear values.

    Args:
        picture: (H, W, 3) linear.
        truth: the same.
        mask: (H, W) bool, as for ``orb_error``.

    Raises:
        ShapeError, OptionError: as ``orb_error``.
    """
    a, b, inside = _prepared(picture, truth, mask)
    a, b = np.clip(channel_scale(a[inside], b[inside]) * a, 0, 1), np.clip(b, 0, 1)
    return OrbError(
        psnr_hdr=None, psnr_ldr=_psnr(a, b, inside), ssim=_ssim(a, b), lpips=lpips(srgb(a), srgb(b))
    )


def channel_scale(picture: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the (3,) factors of a picture's channels that bring it closest to a photograph.

    Args:
        picture: (N, 3) radiance of the object's pixels.
        truth: the same.
    """
    energy = (picture**2).sum(axis=0)
    black = energy <= DARK
    picture, energy = np.where(black, 1.0, picture), np.where(black, len(picture), energy)
    return (picture * truth).sum(axis=0) / energy


def _prepared(picture: Any, truth: Any, mask: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return both pictures, black outside the eroded mask, and that mask."""
    # Beyond the picture's border there may be more of the object: it erodes nothing.
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

    None without the package, which ``pip install lpips`` installs with PyTorch, or without the
    weights of VGG-16, which it downloads when it is first used.

    Args:
        picture: (H, W, 3) in [0, 1], tone-mapped.
        truth: the same.
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
    """Load the network once; None, with a warning unless the package is missing."""
    try:
        from lpips import LPIPS
    except ImportError:
        return None
    try:
        return LPIPS(net="vgg", verbose=False).eval()
    except (OSError, RuntimeError) as error:  # the weights are downloaded, then unpacked
        warnings.warn(
            f"LPIPS is left out: the weights of VGG-16 cannot be loaded ({error}).", SvuWarning,
            stacklevel=2,
        )  # fmt: skip
        return None
