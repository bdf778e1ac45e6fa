"""A ray to a texel, and all that the photographs say of that texel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.look import alone
from svu_mi.errors import OptionError
from svu_mi.interop import owned
from svu_mi.output.knowledge import Intervals
from svu_mi.output.result import place_of
from svu_mi.pipeline import Estimate
from svu_mi.surface import Texels
from svu_mi.surface.raster import dilate


@dataclass(frozen=True, kw_only=True)
class Belief:
    """What is known of a parameter at a texel: arrays of one value, or of one per channel.

    Attributes:
        best: of the most probable material.
        mean: of all that are possible.
        low: lower end of what holds the parameter with the probability ``Pick.level``.
        high: its upper end.
    """

    best: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Pick:
    """One texel, and what the photographs say of it.

    Attributes:
        texel: its number, from 0 to T - 1.
        column: of the texture.
        row: of the texture; row 0 is v = 0.
        position: (3,) float64, the texel's centre in world space.
        entropy: in [0, 1].
        seen_by: indices of the sensors that see it.
        beliefs: by parameter; none if nobody sees it.
        level: probability that an interval holds.
    """

    texel: int
    column: int
    row: int
    position: np.ndarray
    entropy: float
    seen_by: tuple[int, ...]
    beliefs: dict[str, Belief]
    level: float


class Picker:
    """Finds texels on the surface of a capture's object.

    Args:
        capture: only its ``mesh`` is hit, nothing else in the scene.
        estimate: of the capture, as ``svu.estimate`` returns it.
        intervals: of its posterior; if not given, computed at the first pick that needs them.
    """

    def __init__(
        self, capture: Capture, estimate: Estimate, intervals: Intervals | None = None
    ) -> None:
        self._capture, self._estimate = capture, estimate
        self._intervals = intervals or Intervals(estimate.posterior)
        self._nearest = nearest_texel(estimate.texels)
        self._scene = alone(capture)

    def pick(self, origin: Any, direction: Any) -> Pick | None:
        """Return the texel that a ray hits first, None if it misses the object.

        Where a chart is too narrow for a texel's centre, it is the nearest one in the texture.

        Args:
            origin: (3,) of the ray, in world space.
            direction: (3,) of the ray, of any length but 0.
        """
        # Arrays, not numbers: these would be compiled into a new kernel for every ray.
        start, towards = (np.array(v, np.float32)[:, None] for v in (origin, direction))
        ray = mi.Ray3f(owned(mi.Point3f, start), dr.normalize(owned(mi.Vector3f, towards)))
        hit = self._scene.ray_intersect(ray)
        valid, uv = np.array(hit.is_valid()), np.array(hit.uv, np.float64)
        if not valid.all():
            return None
        size = np.array(self._estimate.texels.resolution)
        column, row = np.clip((uv.ravel() * size).astype(int), 0, size - 1)
        return self.describe(int(self._nearest[row, column]))

    def describe(self, texel: int) -> Pick:
        """Return what the photographs say of a texel.

        Raises:
            OptionError: there is no such texel.
        """
        texels = self._estimate.texels
        if not 0 <= texel < texels.count:
            raise OptionError(f"The texel must be 0 to {texels.count - 1}, got {texel}.")
        column, row = place_of(self._estimate, texel)
        seen_by = self._seen_by(texel)
        return Pick(
            texel=texel, column=column, row=row,
            position=np.array(texels.position, np.float64)[:, texel],
            entropy=float(np.array(self._estimate.entropy)[texel]),
            seen_by=seen_by, beliefs=self._beliefs(texel) if seen_by else {},
            level=self._intervals.level,
        )  # fmt: skip

    def _beliefs(self, texel: int) -> dict[str, Belief]:
        posterior, found = self._estimate.posterior, {}
        best = posterior.map([texel])
        for name in posterior.axes:
            low, high = self._intervals.ends(name)
            mean = np.array(posterior.mean(name))[texel]
            found[name] = Belief(
                best=np.atleast_1d(np.array(best[name])[0]), mean=np.atleast_1d(mean),
                low=low[texel], high=high[texel],
            )  # fmt: skip
        return found

    def _seen_by(self, texel: int) -> tuple[int, ...]:
        observed = self._estimate.observed
        if observed is None:
            raise OptionError(
                "The estimate does not know its views; use what svu.estimate() returns."
            )
        used = np.flatnonzero(self._capture.used)
        view = dr.arange(mi.UInt32, len(used))
        seen = observed.found.bits.test(view, owned(mi.UInt32, np.full(len(used), texel)))
        return tuple(used[np.array(seen)].tolist())


def nearest_texel(texels: Texels) -> np.ndarray:
    """Return (H, W) int64: the number of the texel there, or of the nearest one in the texture."""
    width, height = texels.resolution
    numbers = texels.to_image(np.arange(texels.count), -1)
    return dilate(numbers, texels.inside(), float(np.hypot(width, height)))
