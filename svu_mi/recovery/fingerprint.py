"""What a recovery works on, as digests: a checkpoint knows its run by them."""

from __future__ import annotations

from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.fingerprint import Key, capture_parts
from svu_mi.posterior import Posterior
from svu_mi.recovery.textures import Textures
from svu_mi.regularization import GlobalSharing
from svu_mi.surface import Texels


def fingerprint(
    capture: Capture, texels: Texels, start: Textures | None, sharing: GlobalSharing | bool,
    posterior: Posterior | None,
) -> dict[str, str]:  # fmt: skip
    """Return digests of everything but the settings.

    Args:
        capture: scene, photographs, masks and sensors.
        texels: where the textures belong.
        start: the caller's textures, None where the method finds its own.
        sharing: the caller's regulariser, or whether there is one.
        posterior: of the caller's estimate, None for a capture.

    Returns:
        Digests by words for messages: the parts of the capture (``capture_parts``), and
        ``layout of texels``, ``textures to start from``, ``seeds of sharing`` and ``posterior``.
    """
    # Their normals are those of the shape, which has a digest that knows rounding.
    found = {"layout of texels": _digest(texels.index, texels.position)}
    if start is not None:
        found["textures to start from"] = _digest(*(tensor for _, tensor in start.items()))
    if isinstance(sharing, GlobalSharing):
        found["seeds of sharing"] = _digest(sharing.weights, sharing.seeds, [sharing.anchored])
    if posterior is not None:
        noise = getattr(posterior.kernel, "noise", np.empty(0))
        axes = posterior.axes.values()
        found["posterior"] = _digest(posterior.prior, *axes, noise, posterior.entropy())
    return capture_parts(capture) | found


def _digest(*arrays: Any) -> str:
    return Key(*(np.array(array) for array in arrays)).digest()
