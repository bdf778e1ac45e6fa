"""A ray to a texel, and all that the photographs say of that texel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.errors import OptionError
from svu_mi.interop import owned
from svu_mi.output import views
from svu_mi.output.knowledge import Intervals
from svu_mi.output.result import place_of
from svu_mi.pipeline import Estimate
from svu_mi.surface import Texels
from svu_mi.surface.gutter import dilate


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
        most_probable: by parameter, one value, or one per colour channel; None if nobody sees it.
        mean: the same, of the values that are possible.
        interval: the same, lower and upper ends of what holds a parameter with a probability.
        level: that probability.
    """

    texel: int
    column: int
    row: int
    position: np.ndarray
    entropy: float
    seen_by: tuple[int, ...]
    most_probable: dict[str, np.ndarray] | None
    mean: dict[str, np.ndarray] | None
    interval: dict[str, tuple[np.ndarray, np.ndarray]] | None
    level: float


class Picker:
    """Finds texels on the surface of a capture's object.

    Args:
        capture: the ``Capture``; only its ``mesh`` is hit, nothing else in the scene.
        estimate: its ``Estimate``, as ``svu.estimate`` returns it.
        intervals: of its posterior; if not given, computed at the first pick that needs them.
    """

    def __init__(
        self, capture: Capture, estimate: Estimate, intervals: Intervals | None = None
    ) -> None:
        self._capture, self._estimate = capture, estimate
        self._intervals = intervals or Intervals(estimate.posterior)
        self._nearest = nearest_texel(estimate.texels)
        self._scene = views.alone(capture)

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
        texels, posterior = self._estimate.texels, self._estimate.posterior
        if not 0 <= texel < texels.count:
            raise OptionError(f"Texels are numbered 0 to {texels.count - 1}, got {texel}.")
        column, row = place_of(self._estimate, texel)
        seen_by = self._seen_by(texel)
        names = list(posterior.axes)
        return Pick(
            texel=texel,
            column=column,
            row=row,
            position=np.array(texels.position, np.float64)[:, texel],
            entropy=float(np.array(self._estimate.entropy)[texel]),
            seen_by=seen_by,
            most_probable=_of_texel(posterior.map([texel]), 0) if seen_by else None,
            mean=_of_texel({n: posterior.mean(n) for n in names}, texel) if seen_by else None,
            interval={n: self._interval(n, texel) for n in names} if seen_by else None,
            level=self._intervals.level,
        )

    def _interval(self, name: str, texel: int) -> tuple[np.ndarray, np.ndarray]:
        low, high = self._intervals.ends(name)
        return low[texel], high[texel]

    def _seen_by(self, texel: int) -> tuple[int, ...]:
        observed = self._estimate.observed
        if observed is None:
            raise OptionError("The estimate does not know which views it was made from.")
        used = np.flatnonzero(self._capture.used)
        view = dr.arange(mi.UInt32, len(used))
        seen = observed.found.bits.test(view, owned(mi.UInt32, np.full(len(used), texel)))
        return tuple(used[np.array(seen)].tolist())


def nearest_texel(texels: Texels) -> np.ndarray:
    """Return (H, W) int64: the number of the texel there, or of the nearest one in the texture."""
    width, height = texels.resolution
    numbers = texels.to_image(np.arange(texels.count), -1)
    return dilate(numbers, texels.inside(), float(np.hypot(width, height)))


def _of_texel(values: dict[str, Any], index: int) -> dict[str, np.ndarray]:
    """Values of one of several texels: one, or one per colour channel."""
    return {name: np.atleast_1d(np.array(of_all)[index]) for name, of_all in values.items()}
