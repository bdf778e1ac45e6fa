"""Clipped channels: a camera that counts no further says that radiance was at least so much."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Clipped:
    """The clipped channels of one photograph.

    Attributes:
        channels: (H, W) uint8; bit c is set where channel c is clipped.
        least: (3,) float32, the radiance that such a channel has at least.
    """

    channels: np.ndarray
    least: np.ndarray

    @staticmethod
    def of(over: np.ndarray, least: float) -> Clipped:
        """Take flags (H, W, 3), and what all channels are at least."""
        bits = np.array([1, 2, 4], np.uint8)
        return Clipped((over * bits).sum(axis=-1, dtype=np.uint8), np.full(3, least, np.float32))

    @property
    def flags(self) -> np.ndarray:
        """(H, W, 3) bool."""
        return (self.channels[..., None] & np.array([1, 2, 4], np.uint8)) > 0

    def divided(self, gain: np.ndarray | np.floating) -> Clipped:
        """Return what it is of a photograph without its gain, of all channels or of each."""
        return replace(self, least=(self.least / gain).astype(np.float32))
