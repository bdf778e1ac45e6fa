"""Widths of credible intervals, and the fraction of the surface where they are narrow."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.geometry.dilate import dilate
from svu_mi.output.estimate_arrays import is_seen, label_of, open_axes, texel_areas
from svu_mi.output.html import NARROW_SPACE, percent
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.intervals import LEVEL, subsample
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.quadrature import bin_edges

TOLERANCE = 0.05  # largest half-width of an interval that counts as known
WIDEST = 6 * TOLERANCE  # half-width at the upper end of a map's colours
ROUNDING = 1e-6  # rounding of interval ends in single precision
ESTIMATED_LIGHT = (
    "the light or its brightness is estimated, and then, often, fewer than 90 % of the 90 % "
    "intervals of a parameter contain the truth"
)


class Intervals:
    """Half-widths of the ``LEVEL`` intervals of a posterior's parameters, computed on first use.

    ``chosen`` (t,) are texel indices, by default all. With ``nearest`` (T,), indices into
    ``chosen``, half-widths are repeated for all T texels.
    """

    def __init__(
        self, posterior: Posterior, chosen: np.ndarray | None = None,
        nearest: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        self.chosen = np.arange(posterior.count) if chosen is None else chosen
        self._posterior, self._nearest = posterior, nearest
        self._half: dict[str, np.ndarray] = {}

    def half_width(self, name: str) -> np.ndarray:
        """Return half the width of the intervals, (t,) or (T,), of the widest channel (see
        ``Posterior.half_width``)."""
        if name not in self._half:
            half = np.array(self._posterior.half_width(name, LEVEL, self.chosen))
            self._half[name] = half if self._nearest is None else half[self._nearest]
        return self._half[name]


def interval_of(posterior: Posterior, name: str, texel: int) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper end of a texel's ``LEVEL`` interval, one number per channel."""
    low, high = (np.array(end).reshape(-1) for end in posterior.interval(name, LEVEL, [texel]))
    return low, high


def picture_intervals(estimate: Estimate, side: int) -> Intervals:
    """Return intervals, subsampled for a map whose longer side has ``side`` pixels."""
    texels, seen = estimate.texels, is_seen(estimate)
    index, step = np.array(texels.index), -(-max(texels.resolution) // side)
    rows, columns = np.divmod(index, texels.resolution[0])
    chosen = np.flatnonzero(seen & (rows % step == 0) & (columns % step == 0))
    if step == 1 or not len(chosen):
        return Intervals(estimate.posterior)
    numbers = np.full(texels.count, -1)
    numbers[chosen] = np.arange(len(chosen))
    image = texels.to_image(numbers, -1)
    nearest = dilate(image, image >= 0, float(np.hypot(*image.shape))).reshape(-1)[index]
    return Intervals(estimate.posterior, chosen, nearest)


def has_estimated_light(estimate: Estimate) -> bool:
    """Return whether the light or its level is estimated, so that intervals are too narrow."""
    observed = estimate.observed
    return observed is not None and observed.capture.light_uncertainty is not None


def sampled_intervals(estimate: Estimate) -> Intervals:
    """Return the intervals of a few thousand seen texels, which determine shares to 1 or 2 %."""
    return Intervals(estimate.posterior, subsample(np.flatnonzero(is_seen(estimate))))


@dataclass(frozen=True)
class IntervalSummary:
    """Fractions of the surface, by area, whose intervals are within a tolerance.

    Attributes:
        level: Probability of an interval.
        tolerance: Largest half-width of an interval that counts as known.
        seen_part: Fraction of the surface that any photograph shows.
        mean_entropy: Mean entropy of seen texels; None without any.
        known_part: Fraction of the *seen* surface where a parameter is known, by open parameter;
            empty if no texel is seen, or if withheld.
        all_known_part: Fraction of the seen surface where all parameters are known; 0 if unseen,
            None if withheld.
        median_half_width: Median half-width by parameter, over the seen surface.
        cell_width: Width of the grid's widest cell by parameter, if intervals consist of whole
            cells and this width exceeds the tolerance.
        resolution: Width and height of the texture whose texels are counted.
        withheld: Reason why no parameter is called known; empty if intervals can be relied on.
    """

    level: float
    tolerance: float
    seen_part: float
    mean_entropy: float | None
    known_part: dict[str, float]
    all_known_part: float | None
    median_half_width: dict[str, float]
    cell_width: dict[str, float]
    resolution: tuple[int, int]
    withheld: str

    @classmethod
    def of(cls, estimate: Estimate, intervals: Intervals | None = None) -> "IntervalSummary":
        """Summarise the intervals of an estimate.

        ``intervals`` are computed from its posterior (default: ``sampled_intervals``).
        """
        seen, intervals = is_seen(estimate), intervals or sampled_intervals(estimate)
        is_found = has_estimated_light(estimate)
        area = texel_areas(estimate)
        seen_part = area_share(area, seen)
        entropy = np.array(estimate.entropy, np.float64)[seen]
        area, seen = area[intervals.chosen], seen[intervals.chosen]
        names = list(open_axes(estimate)) if seen.any() else []
        half = {name: intervals.half_width(name)[seen] for name in names}
        narrow = {} if is_found else {n: is_within(width, TOLERANCE) for n, width in half.items()}
        every = np.logical_and.reduce(list(narrow.values())) if narrow else np.zeros(0, bool)
        widest = {name: _widest_bin(estimate.posterior, name) for name in names}
        return cls(
            level=LEVEL,
            tolerance=TOLERANCE,
            seen_part=seen_part,
            mean_entropy=float(entropy.mean()) if len(entropy) else None,
            known_part={name: area_share(area[seen], yes) for name, yes in narrow.items()},
            all_known_part=None if is_found else area_share(area[seen], every) if narrow else 0.0,
            median_half_width={
                name: weighted_median(width, area[seen]) for name, width in half.items()
            },
            cell_width={name: w for name, w in widest.items() if not is_within(w / 2, TOLERANCE)},
            resolution=estimate.texels.resolution,
            withheld=ESTIMATED_LIGHT if is_found and names else "",
        )

    def summary(self) -> str:
        """Return "97 % of the surface area seen, mean entropy 0.60. Roughness known to ..."."""
        if self.mean_entropy is None:
            return self.sentence()
        text = f"{plain_percent(self.seen_part)} of the surface area seen, mean entropy "
        return f"{text[0].upper()}{text[1:]}{self.mean_entropy:.2f}. {self.sentence()}"

    def sentence(self) -> str:
        """Return "Roughness known to ±0.05 on 62 % of the surface area seen, metallic on ..."."""
        if not self.seen_part:
            return "No parameter is known: no photograph shows the surface."
        if self.withheld:
            return f"No parameter is called known to ±{self.tolerance:g}: {self.withheld}."
        if not self.known_part:
            return "All parameters were given."
        (first, share), *others = [
            (label_of(n), plain_percent(x)) for n, x in self.known_part.items()
        ]
        clauses = [f"{first} known to ±{self.tolerance:g} on {share} of the surface area seen"]
        clauses += [f"{name} on {share}" for name, share in others]
        limits = f"{100 * self.level:g} % intervals of {'×'.join(map(str, self.resolution))} texels"
        if self.cell_width:
            limits += f"; the grid's cells are up to {max(self.cell_width.values()):.2f} wide"
        text = f"{', '.join(clauses)} ({limits})."
        return text[0].upper() + text[1:]


def is_within(half_width: Any, tolerance: float) -> Any:
    """Check whether half-widths of intervals are within a tolerance."""
    return half_width <= tolerance + ROUNDING


def area_share(area: np.ndarray, chosen: np.ndarray) -> float:
    """Return the area of chosen (T,) texels as a fraction of all; exactly 1 if all are chosen."""
    return float(area[chosen].sum() / area.sum())


def plain_percent(value: float) -> str:
    """Format a fraction as percent, with an ordinary space."""
    return percent(value).replace(NARROW_SPACE, " ")


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the weighted median: the smallest value with at least half the weight up to it."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(below, below[-1] / 2)]])


def _widest_bin(posterior: Posterior, name: str) -> float:
    """Return the width of the grid's widest cell; 0 for continuous intervals."""
    if posterior.continuous:
        return 0.0
    return float(np.diff(bin_edges(posterior.axes[name])).max())
