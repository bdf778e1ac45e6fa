"""Fill what nobody saw by what it is like, and say how sure that is.

    today's: values spread from the border by total variation, from the mean of all that was seen
    here:    the same, towards a guess where that has proved itself

Whether it has is found out on the object itself: parts of the surface that was seen, as large as
those that were not, are hidden in turn, guessed, and compared with what is known of them. A guess
that does not beat spreading from the border is not used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf

import mitsuba as mi
import numpy as np

from svu_mi.errors import CaptureError
from svu_mi.inpaint.filling import SUREST, Filling
from svu_mi.inpaint.hiding import hidden_parts
from svu_mi.inpaint.likeness import LIKENESSES, Likeness, centred
from svu_mi.inpaint.record import Filled
from svu_mi.interop import owned
from svu_mi.parameters import NAMES
from svu_mi.recovery.field.field import TextureField

BORDER = "border"  # what spreading from it is called
TRIED = 3000  # texels of a part that guesses are compared on
MARGIN = 0.8  # of the squared error of spreading, below which a guess is used
NEVER = 1.05  # of that of any part that it is tried on, above which it is not
HARDLY = 1e-3  # precision of the mean of all where nothing is known, in units of their variance
GUESSED = 1e3  # the same of a guess, where it is smoothed


def fill(field: TextureField, seen: np.ndarray, above: float = inf) -> Filled:
    """Fill texels that nobody saw, or that are less sure than asked.

    Args:
        field: recovered textures, and how sure they are.
        seen: (T,) bool, texels that a photograph shows.
        above: standard deviation of any parameter from which on one that was seen is filled, too;
            what is known of it counts as much as it is sure.

    Raises:
        CaptureError: nothing is seen, or nothing surely enough.
    """
    shown, width = np.asarray(seen, bool), field.width
    seen = shown & (width <= above).all(axis=0)
    if seen.any() and seen.all():
        return Filled(field, ~seen, {name: "" for name in NAMES}, {name: 0.0 for name in NAMES})
    parts = hidden_parts(np.array(field.texels.normal, np.float64).T, seen) if seen.any() else []
    if not parts:
        raise CaptureError(
            "fill(): no texel is seen surely enough to fill others by; allow more (above=).",
            shell="No texel is seen surely enough to fill others by; give a larger --above.",
        )
    trial = _Trial(field, centred(np.array(field.texels.position, np.float64).T), seen)
    tried = np.array([trial.errors(hidden) for hidden in parts])
    errors = tried.mean(axis=0)  # (1 + guesses, N)
    filling, names, found = Filling(field, shown), {}, {}
    for name in NAMES:
        rows = field.rows(name)
        of_parts = tried[:, :, rows].mean(axis=2)
        of_name = of_parts.mean(axis=0)
        never_worse = (of_parts <= NEVER * of_parts[:, :1]).all(axis=0)
        better = never_worse & (of_name < MARGIN * of_name[0])
        chosen = int(np.where(better, of_name, np.inf).argmin()) if better.any() else 0
        off = np.sqrt(errors[chosen, rows])[:, None]
        names[name], found[name] = BORDER, float(np.sqrt(of_name[chosen]))
        if chosen:
            guess = LIKENESSES[chosen - 1]
            names[name] = guess.title
            filling.put(name, ~seen, trial.guessed(guess)[rows], off)
        else:
            filling.doubt(name, ~seen, off)
    return Filled(filling.done(~seen), ~seen, names, found)


def by_likeness(
    field: TextureField, known: np.ndarray, likeness: Mapping[str, str]
) -> np.ndarray:
    """Return all values as if only some were known, and the others filled as others have been.

    Args:
        field: recovered textures.
        known: (T,) bool, of what nothing else is looked at.
        likeness: by parameter (``Filled.likeness``).

    Returns:
        (N, T).
    """
    trial = _Trial(field, centred(np.array(field.texels.position, np.float64).T), known)
    values = field.values.copy()
    values[:, ~known] = spread(field, known, ~known)
    for guess in LIKENESSES:
        names = [name for name, title in likeness.items() if title == guess.title]
        found = trial.guessed(guess) if names else values
        for name in names:
            values[field.rows(name)] = found[field.rows(name)]
    return values


@dataclass(frozen=True)
class _Trial:
    """What guesses are tried on.

    Attributes:
        field: recovered textures.
        points: (T, 3) (``centred``).
        seen: (T,) bool.
    """

    field: TextureField
    points: np.ndarray
    seen: np.ndarray

    def errors(self, hidden: np.ndarray) -> np.ndarray:
        """Return the mean squared errors (1 + guesses, N) of texels that were seen, as if they were
        hidden: of spreading, and of every guess, which spreading stands in for where nothing is
        alike."""
        known, texels = self.seen & ~hidden, np.flatnonzero(hidden)
        spread = self._spread(None, known, hidden)
        some = np.linspace(0, len(texels) - 1, min(TRIED, len(texels))).astype(np.int64)
        texels, spread = texels[some], spread[:, some]
        true = self.field.values[:, texels]
        found = [((spread - true) ** 2).mean(axis=1)]
        for guess in LIKENESSES:
            values, alike = self._guess(guess, known, texels)
            found.append(((np.where(alike, values, spread) - true) ** 2).mean(axis=1))
        return np.array(found)

    def guessed(self, guess: Likeness) -> np.ndarray:
        """Return values (N, T), of texels that nobody saw guesses."""
        values = self.field.values.copy()
        values[:, ~self.seen] = self._spread(guess, self.seen, ~self.seen)
        return values

    def _guess(
        self, guess: Likeness, known: np.ndarray, texels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        weights = 1 / self.field.deviation**2
        return guess.guess(
            self.points, np.flatnonzero(known), self.field.values, weights, texels
        )

    def _spread(
        self, guess: Likeness | None, known: np.ndarray, wanted: np.ndarray
    ) -> np.ndarray:
        """Let values spread from the border into what is wanted, and from a guess about it."""
        found, alike = None, np.zeros(0, bool)
        if guess is not None:
            found, alike = self._guess(guess, known, np.flatnonzero(wanted))
        return spread(self.field, known, wanted, found, alike)


def spread(
    field: TextureField, known: np.ndarray, wanted: np.ndarray, guess: np.ndarray | None = None,
    alike: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Let values spread from what is known, as total variation does.

    Args:
        field: whose values.
        known: (T,) bool, of what they are known.
        wanted: (T,) bool, w texels of which they are not.
        guess: (N, w), what they are spread about, by default the mean of what is known.
        alike: (w,) bool, where there is a guess.

    Returns:
        (N, w).
    """
    weights, values = 1 / field.deviation**2, field.values
    mean = (weights * values)[:, known].sum(axis=1) / weights[:, known].sum(axis=1)
    target = np.where(known, values, mean[:, None])
    wide = np.maximum(values[:, known].std(axis=1), SUREST)[:, None]
    trust = np.where(known, weights, HARDLY / wide**2)
    if guess is not None:
        texels = np.flatnonzero(wanted)
        target[:, texels[alike]] = guess[:, alike]
        trust[:, texels[alike]] = GUESSED / wide**2
    smoother = field.smoother.with_precision(trust, blind=~known)
    solved = np.array(smoother.solve(owned(mi.Float, (trust * target).astype("f4").ravel())))
    return np.clip(solved.reshape(trust.shape)[:, wanted], 0, 1)
