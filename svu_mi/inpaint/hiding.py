"""Parts of what was seen that are hidden in turn, to find out how far off guesses are."""

from __future__ import annotations

import numpy as np

from svu_mi.inpaint.ground import Ground

FEWEST, MOST = 2, 6  # parts of the surface that are hidden in turn
DIVISIONS = 2  # ways to divide it, where it is divided into so few


def hidden_parts(ground: Ground) -> list[np.ndarray]:
    """Return parts of what is known, as cameras leave them out.

    Each is what faces one way, or of a flat object what lies on one side, about as large as what
    is not known, so that it is as far from what is.

    Args:
        ground: T texels.

    Returns:
        (T,) bool each; none if nothing would be left to guess from.
    """
    point, normal = ground.pieces.point, ground.pieces.normal
    side = point / np.maximum(np.linalg.norm(point, axis=1, keepdims=True), 1e-9)
    return _divided(normal, ground.known) or _divided(side, ground.known)


def _divided(normal: np.ndarray, seen: np.ndarray) -> list[np.ndarray]:
    """Return parts of what was seen of which the unit vectors (T, 3) are alike."""
    number = int(np.clip(round(seen.sum() / max((~seen).sum(), 1)), FEWEST, MOST))
    numbers = np.flatnonzero(seen)
    found: list[np.ndarray] = []
    ways = DIVISIONS if number == FEWEST else 1
    for owner in (_clusters(normal[seen], number, seed) for seed in range(ways)):
        for k in range(number):
            hidden = np.zeros(len(normal), bool)
            hidden[numbers[owner == k]] = True
            new = not any(np.array_equal(hidden, other) for other in found)
            if new and hidden.any() and (seen & ~hidden).any():
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
