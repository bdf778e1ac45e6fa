"""Fill what nobody saw by what it is like, and say how sure that is.

    today's: values spread from the border by total variation, from the mean of all that was seen
    here:    the same, towards a guess where that has proved itself

Whether it has is found out on the object itself: parts of the surface that was seen, as large as
those that were not, are hidden in turn, guessed, and compared with what is known of them. A guess
that does not beat spreading from the border is not used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import mitsuba as mi
import numpy as np

from svu_mi.errors import CaptureError
from svu_mi.inpaint.likeness import LIKENESSES, Likeness, centred
from svu_mi.interop import owned
from svu_mi.parameters import NAMES
from svu_mi.recovery.field.field import TextureField
from svu_mi.recovery.textures import Textures, lay_out

BORDER = "border"  # what spreading from it is called
FEWEST, MOST = 2, 6  # parts of the surface that are hidden in turn
DIVISIONS = 2  # ways to divide it
TRIED = 3000  # texels of a part that guesses are compared on
MARGIN = 0.8  # of the squared error of spreading, below which a guess is used
NEVER = 1.05  # of that of any part that it is tried on, above which it is not
HARDLY = 1e-3  # precision of the mean of all where nothing is known, in units of their variance
GUESSED = 1e3  # the same of a guess, where it is smoothed
SUREST = 0.02  # standard deviation that no guess is surer than


@dataclass(frozen=True)
class Filled:
    """Textures without holes.

    Attributes:
        field: the textures, and how sure they are; where they were filled, never surer than before.
        filled: (T,) bool, texels that were filled.
        likeness: title of the guess that each parameter was filled with; ``border`` where none was
            better than what had spread from the border, which then stays.
        errors: root mean square error of that on hidden parts, by parameter.
    """

    field: TextureField
    filled: np.ndarray
    likeness: dict[str, str]
    errors: dict[str, float]

    @property
    def textures(self) -> Textures:
        """The textures."""
        return self.field.textures


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
    if not seen.any():
        raise CaptureError(
            "fill(): no texel is seen surely enough to fill others by; allow more (above=).",
            shell="No texel is seen surely enough to fill others by; give a larger --above.",
        )
    if seen.all():
        return Filled(field, ~seen, {name: "" for name in NAMES}, {name: 0.0 for name in NAMES})
    points = centred(np.array(field.texels.position, np.float64).T)
    trial = _Trial(field, points, seen)
    normal = np.array(field.texels.normal, np.float64).T
    tried = np.array([trial.errors(hidden) for hidden in _hidden_parts(normal, seen)])
    errors = tried.mean(axis=0)  # (1 + guesses, N)
    middle, least = field.values.copy(), width.copy()  # never surer than before
    names, found = {}, {}
    for name in NAMES:
        rows = field.rows(name)
        of_parts = tried[:, :, rows].mean(axis=2)
        of_name = of_parts.mean(axis=0)
        never_worse = (of_parts <= NEVER * of_parts[:, :1]).all(axis=0)
        better = never_worse & (of_name < MARGIN * of_name[0])
        chosen = int(np.where(better, of_name, np.inf).argmin()) if better.any() else 0
        guess = LIKENESSES[chosen - 1] if chosen else None
        names[name] = BORDER if guess is None else guess.title
        found[name] = float(np.sqrt(of_name[chosen]))
        wide = np.maximum(np.sqrt(errors[chosen, rows])[:, None], SUREST)
        own = np.where(shown, 1 / np.maximum(width[rows], SUREST) ** 2, 0)[:, ~seen]
        if guess is not None:
            both = own * middle[rows][:, ~seen] + trial.guessed(guess)[rows] / wide**2
            middle[rows][:, ~seen] = both / (own + 1 / wide**2)
        least[rows][:, ~shown] = np.maximum(wide, width[rows][:, ~shown])
    laid = lay_out(field.texels, {name: middle[field.rows(name)].T for name in NAMES})
    textures = field.textures.but(**{name: laid[name] for name in field.names})
    own = np.where(seen, field.own, np.concatenate([middle[field.rows(n)] for n in NAMES]))
    new = replace(field, textures=textures, own=own, least=least)
    return Filled(new, ~seen, names, found)


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
        """Return values (N, w) of texels that nobody saw."""
        return self._spread(guess, self.seen, ~self.seen)

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
        weights = 1 / self.field.deviation**2
        values = self.field.values
        mean = (weights * values)[:, known].sum(axis=1) / weights[:, known].sum(axis=1)
        target = np.where(known, values, mean[:, None])
        wide = np.maximum(values[:, known].std(axis=1), SUREST)[:, None]
        trust = np.where(known, weights, HARDLY / wide**2)
        if guess is not None:
            texels = np.flatnonzero(wanted)
            found, alike = self._guess(guess, known, texels)
            target[:, texels[alike]] = found[:, alike]
            trust[:, texels[alike]] = GUESSED / wide**2
        smoother = self.field.smoother.with_precision(trust, blind=~known)
        solved = np.array(smoother.solve(owned(mi.Float, (trust * target).astype("f4").ravel())))
        return np.clip(solved.reshape(trust.shape)[:, wanted], 0, 1)


def _hidden_parts(normal: np.ndarray, seen: np.ndarray) -> list[np.ndarray]:
    """Return parts of what was seen, (T,) bool each, as cameras leave them out: what faces one way,
    about as large as what was not seen, so that it is as far from what is known."""
    number = int(np.clip(round(seen.sum() / max((~seen).sum(), 1)), FEWEST, MOST))
    numbers, found = np.flatnonzero(seen), []
    for owner in (_clusters(normal[seen], number, seed) for seed in range(DIVISIONS)):
        for k in range(number):
            hidden = np.zeros(len(normal), bool)
            hidden[numbers[owner == k]] = True
            if hidden.any() and (seen & ~hidden).any():
                found.append(hidden)
    return found


def _clusters(unit: np.ndarray, number: int, seed: int) -> np.ndarray:
    """Return which of some clusters each unit vector (n, 3) is in, by spherical k-means."""
    random = np.random.default_rng(seed)
    centres = unit[random.choice(len(unit), min(number, len(unit)), replace=False)]
    for _ in range(8):
        owner = (unit @ centres.T).argmax(axis=1)
        centres = np.stack([
            unit[owner == k].mean(axis=0) if (owner == k).any() else centres[k]
            for k in range(len(centres))
        ])  # fmt: skip
        centres /= np.maximum(np.linalg.norm(centres, axis=1, keepdims=True), 1e-9)
    return np.asarray((unit @ centres.T).argmax(axis=1))
