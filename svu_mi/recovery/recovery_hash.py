"""Digests of the inputs of a recovery, which identify the run of a checkpoint."""

from typing import Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import Key, capture_parts
from svu_mi.geometry.texels import Texels
from svu_mi.posterior.posterior import Posterior
from svu_mi.recovery.regularizers.global_sharing import GlobalSharing
from svu_mi.recovery.svbrdf_textures import Textures


def recovery_digests(
    capture: Capture, texels: Texels, start: Textures | None, sharing: GlobalSharing | bool,
    posterior: Posterior | None,
) -> dict[str, str]:  # fmt: skip
    """Return digests of capture, texels, start, sharing and posterior, by name."""
    # Normals follow from the shape, whose digest tolerates rounding.
    digests = {"layout of texels": _digest(texels.index, texels.position)}
    if start is not None:
        digests["textures to start from"] = _digest(*(tensor for _, tensor in start.items()))
    if isinstance(sharing, GlobalSharing):
        digests["seeds of sharing"] = _digest(sharing.weights, sharing.seeds, [sharing.anchored])
    if posterior is not None:
        noise = getattr(posterior.kernel, "noise", np.empty(0))
        axes = posterior.axes.values()
        digests["posterior"] = _digest(posterior.prior, *axes, noise, posterior.entropy())
    return capture_parts(capture) | digests


def _digest(*arrays: Any) -> str:
    return Key(*(np.array(array) for array in arrays)).digest()
