"""LPIPS, a perceptual distance by a neural network; PyTorch is loaded when it is asked for."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import numpy as np

from svu_mi.errors import SvuWarning


def lpips(found: np.ndarray, truth: np.ndarray) -> float | None:
    """Return the LPIPS distance (Zhang et al., CVPR 2018) by VGG-16, 0 for equal pictures.

    None without the package, which ``pip install lpips`` installs with PyTorch, or without the
    weights of VGG-16, which it downloads when it is first used.

    Args:
        found: (H, W, 3) in [0, 1], tone-mapped.
        truth: the same.
    """
    network = _network()
    if network is None:
        return None
    import torch

    with torch.no_grad():
        a, b = (
            torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)[None], np.float32))
            for picture in (found, truth)
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
