"""What a recovery depends on, as a few numbers: a checkpoint knows its run by them."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.scene import to_world
from svu_mi.light.environment import Environment
from svu_mi.posterior import Posterior
from svu_mi.recovery.textures import Textures
from svu_mi.regularization import GlobalSharing
from svu_mi.surface import Texels


def fingerprint(
    capture: Capture, light: Environment, texels: Texels, start: Textures | None,
    sharing: GlobalSharing | bool, posterior: Posterior | None,
) -> dict[str, Any]:  # fmt: skip
    """Return checksums of everything but the settings.

    Args:
        capture: photographs, masks and poses.
        light: of the capture.
        texels: where the textures belong.
        start: the caller's textures, None where the method finds its own.
        sharing: the caller's regulariser, or whether there is one.
        posterior: of the caller's estimate, None for a capture.

    Returns:
        CRC-32 each: ``photographs``, ``poses``, ``light``, ``texels``, ``start``, ``seeds``,
        ``posterior``; the last three None where nothing was given.
    """
    views = [view for view, used in zip(_views(capture), capture.used, strict=True) if used]
    return {
        "photographs": _checksum(array for image, mask, _ in views for array in (image, mask)),
        "poses": _checksum(pose for *_, pose in views),
        "light": _checksum((light.radiance, light.to_local, light.disk_radiance)),
        "texels": _checksum((texels.index, texels.position, texels.normal)),
        "start": None if start is None else _checksum(tensor for _, tensor in start.items()),
        "seeds": _checksum((sharing.weights, sharing.seeds, [sharing.anchored]))
        if isinstance(sharing, GlobalSharing) else None,
        "posterior": None if posterior is None else _checksum(
            (posterior.prior, *posterior.axes.values(), getattr(posterior, "noise", np.empty(0)),
             posterior.entropy())
        ),
    }  # fmt: skip


def _views(capture: Capture) -> Iterable[tuple[Any, Any, Any]]:
    none = np.empty(0)
    for image, mask, sensor in zip(capture.images, capture.masks, capture.sensors, strict=True):
        yield image, none if mask is None else mask, to_world(sensor)


def _checksum(arrays: Iterable[Any]) -> int:
    result = 0
    for array in arrays:
        result = zlib.crc32(np.ascontiguousarray(np.array(array)).tobytes(), result)
    return result
