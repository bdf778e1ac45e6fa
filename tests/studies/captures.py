"""Captures without files, and with photographs mostly from one side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.bench.captures import chosen_views
from svu_mi.bench.cells import Cell
from svu_mi.bench.experiment import OnCell
from svu_mi.capture import Capture
from svu_mi.capture.scene import to_world
from svu_mi.errors import OptionError
from svu_mi.observed import Observed, observe
from svu_mi.surface import texels

VIEWS, FILM, SPP, TEXELS = 60, 192, 32, 160
FRONT = (0.0, 0.3, 1.0)  # direction from the object to the middle of the crowded side


def in_memory(scene: Any, shape: Any, sensors: Sequence[Any], images: Any) -> Capture:
    """Return a capture without masks, whose every pixel is used.

    Args:
        scene: with the light.
        shape: its target, which has UVs.
        sensors: V of them.
        images: V photographs (H, W, 3).
    """
    count = len(sensors)
    return Capture(
        scene=scene, shape=shape, mesh=shape, sensors=tuple(sensors),
        images=tuple(np.ascontiguousarray(image, np.float32) for image in images),
        masks=(None,) * count, exposures=(1.0,) * count,
        names=tuple(f"view_{view:04d}.exr" for view in range(count)),
        unusable=(0,) * count, used=(True,) * count,
    )  # fmt: skip


def uneven_views(capture: Capture, front: int, back: int) -> Capture:
    """Return the capture with most of its views from one side.

    Args:
        capture: views all around the object.
        front: so many with the smallest angle to the front direction.
        back: so many of the others, evenly spread over the order of that angle.

    Raises:
        OptionError: there are fewer views than that.
    """
    if front + back > capture.count:
        raise OptionError(f"There are {capture.count} views; {front} + {back} are too many.")
    order = nearest_to_front(capture)
    rest = order[front:]
    others = rest[np.linspace(0, len(rest) - 1, back + 2).round().astype(int)[1:-1]]
    return chosen_views(capture, np.sort(np.concatenate([order[:front], others])))


def nearest_to_front(capture: Capture) -> np.ndarray:
    """Return the numbers of all views, by their angle to the front direction."""
    origins = np.array([to_world(sensor)[:3, 3] for sensor in capture.sensors])
    directions = origins - origins.mean(axis=0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axis = np.array(FRONT) / np.linalg.norm(FRONT)
    return np.argsort(-(directions @ axis), kind="stable")


@dataclass(frozen=True)
class Photographed(OnCell):
    """A cell in 60 photographs of 192 x 192, and 160 x 160 texels; far smaller if quick."""

    @cached_property
    def capture(self) -> Capture:
        """The photographs."""
        return self.captured(self.cell)

    def captured(self, cell: Cell) -> Capture:
        """Return photographs of a cell, this or another one."""
        if self.bench.quick:
            return self.bench.capture(cell, views=16, film=64, spp=8)
        return self.bench.capture(cell, views=VIEWS, film=FILM, spp=SPP)

    @cached_property
    def observed(self) -> Observed:
        """What they show."""
        return observe(self.capture, texels(self.capture.mesh, 64 if self.bench.quick else TEXELS))


def mean(values: Iterable[float]) -> float:
    """The mean; NaN, which reaches no bar, of nothing."""
    found = list(values)
    return float(np.mean(found)) if found else float("nan")
