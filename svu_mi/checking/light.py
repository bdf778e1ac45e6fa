"""How the environment map lies: what each of 48 ways predicts, against the photographs.

Neither reflectance nor roughness is known, so only what survives that is compared:

* shading: how brightness changes between neighbouring points, since neighbours mostly are of
  one colour; once as it is, and once without what the texture (or, if there is none, the
  points' own hue) explains;
* highlights: how the brightness of one point changes between views, up to a factor per point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from svu_mi.checking.appearance import DARK, FEWEST, Texture, typical
from svu_mi.checking.hypotheses import Hypothesis, light_hypotheses
from svu_mi.checking.points import Points, Sightings
from svu_mi.checking.sky import Sky
from svu_mi.formats.fixes import turn_of

NEIGHBORS = 8
CLIP = 1.5  # of the median difference of neighbours: edges between colours count no more
ALBEDO_FLOOR = 0.08  # added before taking logarithms: dark surfaces reflect at least some gloss
SPECIAL = 0.3  # of the typical radiance, that a point's changes are relative to at least
FEWER = 0.02  # of the score, that one more correction must be worth


@dataclass(frozen=True)
class LightScore:
    """How well one hypothesis explains the photographs.

    Attributes:
        hypothesis: the corrections.
        shading: correlation of differences between neighbours, with the predicted irradiance's.
        bare: the same without what colours explain.
        highlights: part of the variance between views that filtered light explains.
    """

    hypothesis: Hypothesis
    shading: float
    bare: float
    highlights: float

    @property
    def cues(self) -> dict[str, float]:
        """What the score is made of, by name."""
        return {"shading": self.shading, "shading alone": self.bare, "highlights": self.highlights}

    @property
    def total(self) -> float:
        """What hypotheses are ranked by: the information in all three, less a cost per word."""
        rest = (1 - max(self.shading, 0) ** 2, 1 - max(self.bare, 0) ** 2, 1 - self.highlights)
        return -float(np.log(np.maximum(rest, 1e-3)).sum()) - FEWER * len(self.hypothesis.fixes)


def score_light(
    sky: Sky, points: Points, sightings: Sightings, cosines: np.ndarray,
    texture: Texture | None, step: Callable[[int, int], None],
) -> tuple[LightScore, ...]:  # fmt: skip
    """Try all hypotheses; best first. None if next to nothing of the object is seen.

    Args:
        sky: the light.
        points: on the object.
        sightings: what the views show of them.
        cosines: (N, K), at which light arrives from ``sky.DIRECTIONS`` (``open_cosines``).
        texture: of the object, None if it has none.
        step: called with (hypotheses done, all of them).
    """
    shown, known = typical(sightings)
    if known.sum() < FEWEST:
        return ()
    shading = _Shading.of(points.position[known], shown[known], _features(shown, texture, known))
    highlights = _Highlights.of(points, sightings)
    hypotheses = light_hypotheses()
    scores = []
    for index, hypothesis in enumerate(hypotheses):
        turn = turn_of(hypothesis.fixes, "light")
        irradiance = cosines[known] @ sky.arriving(turn)
        reflected = sky.reflected(highlights.mirror, turn)
        scores.append(
            LightScore(hypothesis, *shading.explained(irradiance), highlights.explained(reflected))
        )
        step(index + 1, len(hypotheses))
    return tuple(sorted(scores, key=lambda score: -score.total))


def _features(shown: np.ndarray, texture: Texture | None, known: np.ndarray) -> np.ndarray:
    """Return (M, F) polynomials in what reflectance is likely to depend on, orthonormal."""
    colors = shown[known] + DARK if texture is None else texture.albedo[known] + ALBEDO_FLOOR
    logs = np.log(colors)
    grey = logs.mean(axis=1, keepdims=True)
    hue = (logs - grey)[:, :2]
    # Photographs without a texture say the hue alone: their brightness is what is compared.
    axes = hue if texture is None else np.concatenate([grey, hue], axis=1)
    axes = 2 * np.tanh((axes - axes.mean(axis=0)) / (axes.std(axis=0) + 1e-3) / 2)
    powers = np.stack(np.meshgrid(*[np.arange(4)] * axes.shape[1]), -1).reshape(-1, axes.shape[1])
    powers = powers[powers.sum(axis=1) < 4]
    terms = np.prod(axes[:, None] ** powers, axis=-1)
    left, size, _ = np.linalg.svd(terms, full_matrices=False)
    return left[:, size > 1e-6 * size[0]]


@dataclass(frozen=True)
class _Shading:
    """Differences of log radiance between neighbouring points.

    Attributes:
        pairs: (P, 2) indices of neighbours.
        features: (M, F), orthonormal columns.
        differences: (P, 3), clipped.
        bare: the same without what features explain.
    """

    pairs: np.ndarray
    features: np.ndarray
    differences: np.ndarray
    bare: np.ndarray

    @staticmethod
    def of(position: np.ndarray, shown: np.ndarray, features: np.ndarray) -> _Shading:
        pairs, logs = neighbors_of(position), np.log(shown + DARK)
        return _Shading(
            pairs, features, clipped_differences(logs, pairs),
            clipped_differences(logs - features @ (features.T @ logs), pairs),
        )  # fmt: skip

    def explained(self, irradiance: np.ndarray) -> tuple[float, float]:
        """Return both correlations for (M, 3) predicted irradiance."""
        logs = np.log(irradiance + DARK * irradiance.mean() + 1e-300)
        bare = logs - self.features @ (self.features.T @ logs)
        return (
            _correlation(clipped_differences(logs, self.pairs), self.differences),
            _correlation(clipped_differences(bare, self.pairs), self.bare),
        )


def neighbors_of(position: np.ndarray) -> np.ndarray:
    """Return (P, 2) indices of points (N, 3), each with those nearest to it."""
    count = min(NEIGHBORS + 1, len(position))
    near = scipy.spatial.cKDTree(position).query(position, k=count)[1][:, 1:]
    return np.stack([np.repeat(np.arange(len(position)), count - 1), near.ravel()], axis=-1)


def clipped_differences(values: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return differences (P, ...) of values (N, ...) in pairs; edges count no more than others."""
    found = values[pairs[:, 0]] - values[pairs[:, 1]]
    limit = CLIP * float(np.median(np.abs(found)))
    return np.clip(found, -limit, limit)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    product = np.sqrt((a * a).sum() * (b * b).sum())
    return float((a * b).sum() / product) if product > 1e-12 else 0.0


@dataclass(frozen=True)
class _Highlights:
    """How what views show of one point differs between them.

    Attributes:
        mirror: (V N, 3) directions that views of N points mirror, in the frame of the mesh.
        seen: (V, N, 1) bool, of points that several views see.
        weight: (N, 1), one over the point's brightness.
        changes: (V, N, 3) weighted radiance less the point's mean, 0 where not seen.
    """

    mirror: np.ndarray
    seen: np.ndarray
    weight: np.ndarray
    changes: np.ndarray

    @staticmethod
    def of(points: Points, sightings: Sightings) -> _Highlights:
        toward, shown = sightings.toward, sightings.radiance
        cosine = np.einsum("vni,ni->vn", toward, points.normal)[..., None]
        mirror = 2 * cosine * points.normal - toward
        seen = (sightings.seen & (sightings.seen.sum(axis=0) >= 2))[..., None]
        mean = _means(shown, seen).mean(axis=1, keepdims=True)
        unit = float(mean.mean(where=seen.any(axis=0))) if seen.any() else 1.0
        weight = 1 / (mean + SPECIAL * unit + 1e-12)
        return _Highlights(mirror.reshape(-1, 3), seen, weight, weight * _changes(shown, seen))

    def explained(self, reflected: np.ndarray) -> float:
        """Return the part of the changes that (L, V N, 3) light explains, by the best lobe."""
        whole = (self.changes**2).sum()
        best = 0.0
        for light in reflected.reshape(len(reflected), *self.changes.shape):
            predicted = self.weight * _changes(light, self.seen)
            product = (predicted * self.changes).sum(axis=(0, 2))
            square = (predicted**2).sum(axis=(0, 2))
            part = np.maximum(product, 0) ** 2 / np.where(square > 0, square, 1)
            best = max(best, float(part.sum() / max(whole, 1e-12)))
        return best


def _means(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return np.where(seen, values, 0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)


def _changes(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return np.where(seen, values - _means(values, seen), 0)


def indistinguishable(
    scores: Sequence[LightScore], best: LightScore, margin: float
) -> list[LightScore]:
    """Return the other hypotheses that explain the photographs as well, to a margin."""
    return [s for s in scores if s is not best and s.total > best.total - margin]
