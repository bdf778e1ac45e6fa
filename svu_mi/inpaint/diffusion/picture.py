"""What a model is given of one view, and what anything that stands in for one has to do."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np


@dataclass(frozen=True)
class Picture:
    """What a model is given of one view, h x w pixels.

    Attributes:
        photograph: (h, w, 3) linear, exposed so that 1 is white; in [0, 1].
        maps: by parameter, (h, w, 3) or (h, w), in [0, 1]: what is known of it where that is
            certain, a first guess elsewhere; 0 off the object.
        certain: (h, w) bool, pixels that show nothing but what is known.
        sensor: where from.
    """

    photograph: np.ndarray
    maps: Mapping[str, np.ndarray]
    certain: np.ndarray
    sensor: Any


class Inventor(Protocol):
    """Whoever makes maps of a whole picture from what is known of a part of it."""

    @property
    def title(self) -> str:
        """For people."""

    @property
    def licence(self) -> str:
        """Of its weights, for people."""

    @property
    def runs(self) -> int:
        """How many times all steps are taken for one picture."""

    def invent(
        self, picture: Picture, steps: int, free: int, seed: int, after_step: Callable[[], None]
    ) -> Mapping[str, np.ndarray]:
        """Return maps of a picture as ``Picture.maps`` has them, by parameter, linear.

        Args:
            picture: what is known.
            steps: of the diffusion.
            free: of these, the last ones in which nothing that is known is put back.
            seed: the same seed, the same maps.
            after_step: called after every step of every run.
        """
