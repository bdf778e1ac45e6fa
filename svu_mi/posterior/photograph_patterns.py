"""Patterns of residuals by photograph: its brightness, its shift, and the object that it shows."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from svu_mi.posterior.residuals import Residuals

DARK = 0.05  # added before logarithms, in mean radiances
FEWEST, MANY = 20, 40  # samples of a photograph that give its gain, and its shift
STEPS = (2, 1)  # of image shifts, coarse to fine
STARTS, ROUNDS = 8, 10  # of the search for two groups of photographs
GROUPS = 0.2  # least effect of two groups of photographs


@dataclass(frozen=True)
class PhotographPatterns(Residuals):
    """Differences between photographs."""

    def gains(self, predicted: np.ndarray) -> np.ndarray:
        """Return the median log ratio to predicted radiance of each photograph, (V,)."""
        view, views = self.samples.view, len(self.around.cameras)
        grey, expected = (np.maximum(x.mean(axis=1), 0) for x in (self.samples.radiance, predicted))
        ratio = np.log((grey + DARK * self.unit) / (expected + DARK * self.unit))
        return np.array([np.median(ratio[view == v]) if (view == v).sum() >= FEWEST else 0.0
                         for v in range(views)])  # fmt: skip

    @cached_property
    def gain(self) -> tuple[float, float]:
        """Standard deviation of log gains, and the part of the error that they explain."""
        of_means = self.gains(self.radiance_of_means)
        of_model = self.gains(self.samples.predicted)
        equal = self.samples.radiance / np.exp(of_model[self.samples.view])[:, None]
        left = np.square(self.compressed(equal) - self.predicted).sum()
        part = 1 - left / max(np.square(self.shown - self.predicted).sum(), 1e-12)
        return min(float(of_means.std()), float(of_model.std())), float(part)

    @cached_property
    def shift(self) -> tuple[float, float]:
        """Part of the error that the best shift of each photograph explains, and its median.

        Shifts are in hundredths of the size of the image.
        """
        view, views = self.samples.view, len(self.around.cameras)

        shifted = self.around.pixels(view, self.samples.texel)

        def errors(shift: np.ndarray) -> np.ndarray:
            off = self.compressed(shifted(shift[view])) - self.predicted
            return np.bincount(view, np.einsum("sc,sc->s", off, off), views)

        best = np.zeros((views, 2))
        first = least = errors(best)
        for step in STEPS:
            start = best
            for offset in np.moveaxis(np.mgrid[-2:3, -2:3], 0, -1).reshape(-1, 2) * float(step):
                error = errors(start + offset)
                better = error < least
                best = np.where(better[:, None], start + offset, best)
                least = np.where(better, error, least)
        many = np.bincount(view, minlength=views) >= MANY
        if not many.any():
            return 0.0, 0.0
        part = 1 - least[many].sum() / max(first[many].sum(), 1e-12)
        return float(part), float(np.median(np.abs(best[many]).max(axis=1)))

    @cached_property
    def groups(self) -> float:
        """Variance that means of texels in two groups of photographs explain.

        More than overall means; of samples, or residuals if that is less. 0 if it cannot exceed
        ``GROUPS``.
        """
        of_residuals = self._grouped(self.shown - self.predicted)
        return min(of_residuals, self._grouped(self.shown)) if of_residuals > 0 else 0.0

    def _grouped(self, off: np.ndarray) -> float:
        views, random = len(self.around.cameras), np.random.default_rng(0)
        total = max(float(self.shown.var(axis=0).sum()) * len(self.shown), 1e-12)
        whole = least = self._left_out(off, np.zeros(views, np.int64))[0]
        if whole <= GROUPS * total:
            return 0.0
        for _ in range(STARTS):
            group = random.permutation(np.arange(views) % 2)
            for _ in range(ROUNDS):
                error, of_groups = self._left_out(off, group)
                least = min(least, error)
                new = np.argmin(of_groups, axis=1)
                if (new == group).all() or min(new.sum(), views - new.sum()) < views / 5:
                    break
                group = new
        return (whole - least) / total

    def _left_out(self, off: np.ndarray, group: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the error of means without the sample itself, and (V, 2) errors by group."""
        texel, own = self.samples.texel, group[self.samples.view]
        place, size = 2 * texel + own, 2 * (int(texel.max()) + 1)
        count = np.bincount(place, minlength=size)
        sums = np.stack([np.bincount(place, column, size) for column in off.T], axis=1)
        errors = []
        for other in range(2):
            mine = (own == other)[:, None]
            number = count[2 * texel + other][:, None] - mine
            mean = (sums[2 * texel + other] - mine * off) / np.maximum(number, 1)
            left = off - mean
            square = np.einsum("sc,sc->s", left, left)
            errors.append(np.bincount(self.samples.view, square, len(group)))
        of_groups = np.stack(errors, axis=1)
        return float(of_groups[np.arange(len(group)), group].sum()), of_groups
