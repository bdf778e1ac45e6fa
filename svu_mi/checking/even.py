"""Whether a light that is the same from everywhere can be that of the photographs.

Under such a light no side of an object is brighter than another: brightness depends on colour, and
on how much of the sky a point sees. So two things are asked about the direction that the surface
faces: how much of the differences between neighbours it explains, beyond how open they are; and how
much of all brightness goes with it. Paint may do the one or the other, but hardly both.

Constants are chosen on our own three objects, 16 photographs of 96 pixels, in their own colours and
in matte, glossy and metal ones. Under even light, the first is at most 0.05 and the second 0.06;
with even light given for the studio, the clear sky or the window at least 0.11 and 0.50; for the
overcast sky, which differs little from it, 0.01 and 0.07.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from svu_mi.checking.appearance import DARK, SHADING_DEGREE, typical
from svu_mi.checking.light import clipped_differences, neighbors_of
from svu_mi.checking.points import Points, Sightings
from svu_mi.light.environment import basis_at

FEWEST = 200  # points: of a few, anything explains much
LOCAL, SPREAD = 0.08, 0.25  # from which the light is doubted, both


@dataclass(frozen=True)
class Facing:
    """What goes with the direction that the surface faces.

    Attributes:
        local: part of the differences in log brightness of neighbours, in [0, 1].
        spread: standard deviation of log brightness.
    """

    local: float
    spread: float

    @property
    def contradicts(self) -> bool:
        """Whether a light that is the same from everywhere can hardly do it."""
        return self.local > LOCAL and self.spread > SPREAD


def facing(points: Points, sightings: Sightings, cosines: np.ndarray) -> Facing | None:
    """Ask what the direction explains; None if too little of the object is seen.

    Args:
        points: N of them.
        sightings: what the views show of them.
        cosines: (N, K), see ``open_cosines``; of even directions.
    """
    shown, known = typical(sightings)
    if known.sum() < FEWEST:
        return None
    shown, arriving = shown[known].mean(axis=1), cosines[known].sum(axis=1, dtype=np.float64)
    if not (shown > 0).any() or not (arriving > 0).any():
        return None
    brightness, openness = (np.log(x + DARK * x.mean()) for x in (shown, arriving))
    sides = basis_at(points.normal[known], SHADING_DEGREE)[:, 1:]  # the first is constant
    pairs = neighbors_of(points.position[known])
    steps = clipped_differences(brightness, pairs)
    open_steps = np.stack(
        [clipped_differences(openness, pairs), _differences(openness, pairs)], axis=1
    )
    side_steps = np.concatenate([open_steps, _differences(sides, pairs)], axis=1)
    plain = np.stack([np.ones_like(openness), openness], axis=1)
    fit = np.linalg.lstsq(np.concatenate([plain, sides], axis=1), brightness, rcond=None)[0]
    return Facing(
        local=_explained(side_steps, steps) - _explained(open_steps, steps),
        spread=float((sides @ fit[plain.shape[1] :]).std()),
    )


def _differences(values: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    return values[pairs[:, 0]] - values[pairs[:, 1]]


def _explained(features: np.ndarray, values: np.ndarray) -> float:
    """Return the part of (P,) values that (P, F) features explain, in [0, 1]."""
    rest = values - features @ np.linalg.lstsq(features, values, rcond=None)[0]
    return 1 - float((rest @ rest) / max(values @ values, 1e-300))
