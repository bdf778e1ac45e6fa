"""Scores of the 48 orientations of an environment map, and a test of constant light.

Reflectance and roughness are unknown, so the comparison uses

* shading: differences of brightness between neighbouring points, which mostly have equal colours;
  before and after regression on texture (or hue, without a texture);
* highlights: changes of the brightness of a point between views, up to a factor per point.

Under constant light, brightness depends on colour and ambient occlusion, not on the normal. The
light is implausible if the normal explains both the differences between neighbours and the
overall brightness; paint rarely causes both. On three objects (16 photographs of 96 pixels; their
own, matte, glossy and metal materials), ``local`` and ``spread`` are at most 0.05 and 0.06 under
constant light. If constant light is assumed instead of the studio, clear sky or window, they are
at least 0.11 and 0.50; instead of the overcast sky, which is nearly constant, 0.01 and 0.07.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from svu_mi.calibration.checks.axis_hypotheses import FEWER, AxisHypothesis, light_hypotheses
from svu_mi.calibration.checks.surface_samples import (
    DARK,
    FEWEST,
    SHADING_DEGREE,
    DistantLight,
    Points,
    PointSamples,
    Texture,
)
from svu_mi.capture.importers.axis_fixes import fix_rotation
from svu_mi.light.environment import basis_at

NEIGHBORS = 8
CLIP = 1.5  # limit of differences at colour edges, relative to their median
ALBEDO_FLOOR = 0.08  # added before logarithms: dark surfaces are also glossy
SPECIAL = 0.3  # fraction of the mean radiance, added before division
FEWEST_EVEN = 200  # points needed to test a constant light
LOCAL, SPREAD = 0.08, 0.25  # a constant light is implausible above both


@dataclass(frozen=True)
class LightScore:
    """Score of one orientation.

    Attributes:
        hypothesis: Tested corrections.
        shading: Correlation of differences between neighbours: radiance and irradiance.
        bare: As ``shading``, after regression on colour.
        highlights: Fraction of the variance between views that filtered light explains.
    """

    hypothesis: AxisHypothesis
    shading: float
    bare: float
    highlights: float

    @property
    def cues(self) -> dict[str, float]:
        """Parts of the score, by name."""
        return {"shading": self.shading, "shading alone": self.bare, "highlights": self.highlights}

    @property
    def total(self) -> float:
        """Sum of the information of the cues, minus a cost per correction."""
        rest = (1 - max(self.shading, 0) ** 2, 1 - max(self.bare, 0) ** 2, 1 - self.highlights)
        return -float(np.log(np.maximum(rest, 1e-3)).sum()) - FEWER * len(self.hypothesis.fixes)


def score_light(
    sky: DistantLight, points: Points, sightings: PointSamples, cosines: np.ndarray,
    texture: Texture | None, step: Callable[[int, int], None],
) -> tuple[LightScore, ...]:  # fmt: skip
    """Return all scores, best first; empty if too little of the object is seen.

    Args:
        sky: Distant light.
        points: N surface points.
        sightings: Samples of the points.
        cosines: (N, K) ``open_cosines`` of ``surface_samples.DIRECTIONS``.
        texture: Texture of the object, or None.
        step: Callback with (completed, total) hypotheses.
    """
    shown, known = sightings.typical()
    if known.sum() < FEWEST:
        return ()
    shading = _shading(points.position[known], shown[known], _features(shown, texture, known))
    mirror, highlights = _highlights(points, sightings)
    hypotheses = light_hypotheses()
    scores = []
    for index, hypothesis in enumerate(hypotheses):
        turn = fix_rotation(hypothesis.fixes, "light")
        irradiance = cosines[known] @ sky.arriving(turn)
        explained = highlights(sky.reflected(mirror, turn))
        scores.append(LightScore(hypothesis, *shading(irradiance), explained))
        step(index + 1, len(hypotheses))
    return tuple(sorted(scores, key=lambda score: -score.total))


def _features(shown: np.ndarray, texture: Texture | None, known: np.ndarray) -> np.ndarray:
    """Return (M, F) orthonormal polynomials of the texture or, without it, of the hue."""
    colors = shown[known] + DARK if texture is None else texture.albedo[known] + ALBEDO_FLOOR
    logs = np.log(colors)
    grey = logs.mean(axis=1, keepdims=True)
    hue = (logs - grey)[:, :2]
    # Without a texture only hue is used: brightness is the compared quantity.
    axes = hue if texture is None else np.concatenate([grey, hue], axis=1)
    axes = 2 * np.tanh((axes - axes.mean(axis=0)) / (axes.std(axis=0) + 1e-3) / 2)
    powers = np.stack(np.meshgrid(*[np.arange(4)] * axes.shape[1]), -1).reshape(-1, axes.shape[1])
    powers = powers[powers.sum(axis=1) < 4]
    terms = np.prod(axes[:, None] ** powers, axis=-1)
    left, size, _ = np.linalg.svd(terms, full_matrices=False)
    return left[:, size > 1e-6 * size[0]]


def _shading(
    position: np.ndarray, shown: np.ndarray, features: np.ndarray
) -> Callable[[np.ndarray], tuple[float, float]]:
    """Return a function of the irradiance (M, 3) that returns two correlations with the radiance.

    Both correlate clipped log differences between neighbouring points; for the second one,
    irradiance and radiance are first regressed on orthonormal features (M, F).
    """
    pairs = neighbors_of(position)

    def differences(values: np.ndarray) -> list[np.ndarray]:
        logs = np.log(values)
        bare = logs - features @ (features.T @ logs)
        return [clipped_differences(each, pairs) for each in (logs, bare)]

    measured = differences(shown + DARK)

    def explained(irradiance: np.ndarray) -> tuple[float, float]:
        predicted = differences(irradiance + DARK * irradiance.mean() + 1e-300)
        whole, bare = map(_correlation, predicted, measured)
        return whole, bare

    return explained


def neighbors_of(position: np.ndarray) -> np.ndarray:
    """Return (P, 2) index pairs of points (N, 3) and their nearest neighbours."""
    count = min(NEIGHBORS + 1, len(position))
    near = scipy.spatial.cKDTree(position).query(position, k=count)[1][:, 1:]
    return np.stack([np.repeat(np.arange(len(position)), count - 1), near.ravel()], axis=-1)


def clipped_differences(values: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return clipped differences (P, ...) of values (N, ...) between points of pairs."""
    steps = _differences(values, pairs)
    limit = CLIP * float(np.median(np.abs(steps)))
    return np.clip(steps, -limit, limit)


def _differences(values: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    return values[pairs[:, 0]] - values[pairs[:, 1]]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    product = np.sqrt((a * a).sum() * (b * b).sum())
    return float((a * b).sum() / product) if product > 1e-12 else 0.0


def _highlights(
    points: Points, sightings: PointSamples
) -> tuple[np.ndarray, Callable[[np.ndarray], float]]:
    """Return mirror directions (V N, 3), and a function that scores light (L, V N, 3) from there.

    The light is filtered by L lobes. The score is the fraction of a point's changes between views,
    relative to the brightness of the point, that the best lobe explains.
    """
    _, mirror = sightings.mirrored(points)
    seen = (sightings.seen & (sightings.seen.sum(axis=0) >= 2))[..., None]
    count = np.maximum(seen.sum(axis=0), 1)

    def means(values: np.ndarray) -> np.ndarray:
        return np.where(seen, values, 0).sum(axis=0) / count

    mean = means(sightings.radiance).mean(axis=1, keepdims=True)
    unit = float(mean.mean(where=seen.any(axis=0))) if seen.any() else 1.0
    weight = 1 / (mean + SPECIAL * unit + 1e-12)

    def changes(values: np.ndarray) -> np.ndarray:
        return weight * np.where(seen, values - means(values), 0)

    measured = changes(sightings.radiance)

    def explained(reflected: np.ndarray) -> float:
        best = 0.0
        for light in reflected.reshape(-1, *measured.shape):
            predicted = changes(light)
            product = (predicted * measured).sum(axis=(0, 2))
            square = (predicted**2).sum(axis=(0, 2))
            part = np.maximum(product, 0) ** 2 / np.where(square > 0, square, 1)
            best = max(best, float(part.sum() / max((measured**2).sum(), 1e-12)))
        return best

    return mirror.reshape(-1, 3), explained


@dataclass(frozen=True)
class NormalDependence:
    """Dependence of brightness on the normal.

    Attributes:
        local: Fraction of log brightness differences of neighbours that normals explain.
        spread: Standard deviation of the log brightness that normals explain.
    """

    local: float
    spread: float

    @property
    def contradicts(self) -> bool:
        """True if a constant light is implausible."""
        return self.local > LOCAL and self.spread > SPREAD


def normal_dependence(
    points: Points, sightings: PointSamples, cosines: np.ndarray
) -> NormalDependence | None:
    """Regress brightness on the normal; None if too little of the object is seen.

    ``cosines``: (N, K) ``open_cosines`` of evenly spaced directions.
    """
    shown, known = sightings.typical()
    if known.sum() < FEWEST_EVEN:
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
    return NormalDependence(
        local=_explained_part(side_steps, steps) - _explained_part(open_steps, steps),
        spread=float((sides @ fit[plain.shape[1] :]).std()),
    )


def _explained_part(features: np.ndarray, values: np.ndarray) -> float:
    """Return the fraction of (P,) values that (P, F) features explain, in [0, 1]."""
    rest = values - features @ np.linalg.lstsq(features, values, rcond=None)[0]
    return 1 - float((rest @ rest) / max(values @ values, 1e-300))
