"""Scores of camera and mesh corrections, and the fit of each photograph."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from svu_mi.calibration.checks.axis_hypotheses import FEWER, AxisHypothesis, pose_hypotheses
from svu_mi.calibration.checks.check_result import ViewCheck
from svu_mi.calibration.checks.surface_samples import (
    DIRECTIONS,
    DistantLight,
    Points,
    Texture,
    agreement,
    emitter_of,
    open_cosines,
    read_texture,
    sample_points,
    scatter_points,
)
from svu_mi.calibration.checks.thumbnails import (
    Thumbnails,
    contrast,
    limit_views,
    outline,
    overlap,
    reduce_photographs,
    silhouettes,
)
from svu_mi.capture.capture import Capture

VIEWS, SMALL = 24, 64  # views and pixels per side for silhouettes of all hypotheses
NEAR = 0.2  # colours are compared up to this distance from the best silhouettes
FEWEST, KEPT = 5, 12  # minimum and maximum number of hypotheses with compared colours
CERTAIN = 3.0  # significance in standard errors
AGREEING = 0.3  # minimum agreement of views that supports a hypothesis
DECISIVE = 0.1  # difference of silhouette fits that decides alone


@dataclass(frozen=True)
class PoseScore:
    """Score of one hypothesis.

    Attributes:
        hypothesis: Tested corrections.
        masked: True if silhouettes are compared with masks.
        fits: (V,) intersection over union with the mask, or gradient rank along the outline.
        agreement: Agreement of views, see ``surface_samples.agreement``.
        texture: Correlation with the texture, as given or flipped; 0 without texture.
        misfit: (N,) residual variances, see ``texture_fit``; NaN for unseen points.
    """

    hypothesis: AxisHypothesis
    masked: bool
    fits: np.ndarray
    agreement: float
    texture: float
    misfit: np.ndarray

    @property
    def silhouette(self) -> float:
        """Mean of ``fits`` over views."""
        return float(self.fits.mean())

    @property
    def cues(self) -> dict[str, float]:
        """Parts of the score, by name."""
        kind = "silhouettes" if self.masked else "contrast"
        kind = f"{kind} at {SMALL} pixels"
        return {kind: self.silhouette, "views agree": self.agreement, "texture": self.texture}

    @property
    def total(self) -> float:
        """Weighted sum of the parts, minus a cost per correction."""
        cost = FEWER * len(self.hypothesis.fixes)
        return 2 * self.silhouette + self.agreement + max(self.texture, 0.0) - cost


def score_poses(
    capture: Capture, points: Points, texture: Texture | None, step: Callable[[int, int], None]
) -> tuple[PoseScore, ...]:
    """Return scores of the likely hypotheses on reduced photographs, best first."""
    frames = Thumbnails.of(capture)
    small = Thumbnails.of(limit_views(reduce_photographs(capture, SMALL), VIEWS))
    hypotheses = pose_hypotheses()
    masked, judge = silhouette_fit(small)
    fits = []
    for index, hypothesis in enumerate(hypotheses):
        fits.append(judge(silhouettes(small.posed(hypothesis.relative_poses(small.poses)))))
        step(index + 1, len(hypotheses))
    means = np.array([one.mean() for one in fits])
    near = int((means >= means.max() - NEAR).sum())
    order = np.argsort(-means, kind="stable")[: max(FEWEST, min(near, KEPT))]
    spread, scores = frames.spread, []
    for index in dict.fromkeys([0, *order.tolist()]):
        hypothesis = hypotheses[index]
        seen = sample_points(points, frames.posed(hypothesis.relative_poses(frames.poses)))
        best, misfit = 0.0, np.full(len(points.position), np.nan)
        if texture is not None:
            best, misfit = max(texture.fits(seen, points), key=lambda pair: pair[0])
        views = agreement(seen, spread)
        scores.append(PoseScore(hypothesis, masked, fits[index], views, best, misfit))
    return tuple(sorted(scores, key=lambda score: -score.total))


SilhouetteFit = Callable[[Sequence[np.ndarray]], np.ndarray]


def silhouette_fit(frames: Thumbnails) -> tuple[bool, SilhouetteFit]:
    """Return whether there are enough masks, and the function that scores silhouettes."""
    pairs = [(k, mask) for k, mask in enumerate(frames.masks) if mask is not None and mask.any()]
    if len(pairs) >= min(frames.views.number, 3):
        return True, lambda seen: np.array([overlap(seen[view], mask) for view, mask in pairs])
    ranks = [contrast(image) for image in frames.radiance]
    return False, lambda seen: np.array(
        [outline_contrast(*pair) or 0.0 for pair in zip(seen, ranks, strict=True)]
    )


def outline_contrast(seen: np.ndarray, rank: np.ndarray) -> float | None:
    """Return the mean gradient rank along an outline; None if the outline is empty."""
    edge = outline(seen)
    return float(rank[edge].mean()) if edge.any() else None


def clearly_better(one: PoseScore, other: PoseScore) -> bool:
    """Return whether a hypothesis is significantly better in one cue, and worse in none.

    Much better silhouettes suffice, as views agree less on a shiny object than on background.
    """
    for better, worse in ((one, other), (other, one)):
        closer = better.fits - worse.fits
        if closer.mean() > DECISIVE and is_significant(closer):
            return better is one
    return any(_favoring_cues(one, other)) and not any(_favoring_cues(other, one))


def differs_in_texture_only(one: PoseScore, other: PoseScore) -> bool:
    """Return whether neither silhouettes nor agreement of views favour ``one``."""
    closer = one.fits - other.fits
    decisive = closer.mean() > DECISIVE and is_significant(closer)
    return not decisive and not any(_favoring_cues(one, other)[:2])


def _favoring_cues(one: PoseScore, other: PoseScore) -> tuple[bool, bool, bool]:
    """Return three flags: silhouettes, agreement of views, or texture favour ``one``."""
    closer = one.silhouette - other.silhouette
    shapes = closer > 0.005 and 1 - other.silhouette > 1.3 * (1 - one.silhouette)
    shapes = shapes if one.masked else closer > 0.015
    shapes &= is_significant(one.fits - other.fits)
    # Ignore low agreement: the background agrees better than a flat or shiny object.
    views = one.agreement > max(AGREEING, other.agreement + 0.15, 1.5 * other.agreement)
    known = np.isfinite(one.misfit) & np.isfinite(other.misfit)
    colors = one.texture - other.texture > 0.015
    colors &= is_significant((other.misfit - one.misfit)[known])
    return bool(shapes), bool(views), bool(colors)


def is_significant(differences: np.ndarray) -> bool:
    """Return whether the mean of differences is significantly above 0."""
    if len(differences) < 4:
        return bool(len(differences) and differences.min() > 0)
    error = differences.std(ddof=1) / np.sqrt(len(differences))
    return bool(differences.mean() > CERTAIN * error)


def simplest(scores: Sequence[PoseScore]) -> tuple[PoseScore, list[PoseScore]]:
    """Choose the hypothesis with the fewest corrections among the best.

    Hypotheses are equally good if the difference is not significant; a symmetric object looks the
    same after a mirroring or rotation. Scores are given best first.

    Returns:
        The choice, and equally good hypotheses that are as simple or need a single correction.
    """
    equal = [score for score in scores if not clearly_better(scores[0], score)]
    chosen = min(equal, key=lambda score: len(score.hypothesis.fixes))
    names = chosen.hypothesis.names
    others = [score for score in equal if len(score.hypothesis.fixes) <= max(len(names), 1)]
    return chosen, [score for score in others if score.hypothesis.names != names]


def check_views(capture: Capture) -> tuple[ViewCheck, ...]:
    """Compare each used photograph of a reduced capture with mesh, texture and light."""
    frames = Thumbnails.of(capture)
    rows = zip(
        np.flatnonzero(capture.used).tolist(), silhouettes(frames), frames.masks, frames.radiance,
        _color_errors(capture, frames), strict=True,
    )  # fmt: skip
    return tuple(
        ViewCheck(
            view=view,
            name=capture.names[view],
            overlap=None if mask is None else overlap(seen, mask),
            contrast=outline_contrast(seen, contrast(radiance)),
            color_error=error,
        )
        for view, seen, mask, radiance, error in rows
    )


def _color_errors(capture: Capture, frames: Thumbnails) -> list[float | None]:
    """Return the mean relative error of a diffuse rendering per view; None if not available.

    Reflectance is the texture, or one colour, times the best factor per channel.
    """
    emitter = emitter_of(capture)
    if emitter is None:
        return [None] * frames.views.number
    points = scatter_points(capture.shape)
    sightings, texture = sample_points(points, frames), read_texture(capture, points)
    flux = DistantLight.of(emitter, np.eye(3)).arriving(np.eye(3))
    albedo = 1.0 if texture is None else texture.albedo
    predicted = albedo * (open_cosines(capture.scene, points, DIRECTIONS) @ flux) / np.pi
    view, point = np.nonzero(sightings.seen)
    shown, model = sightings.radiance[view, point], predicted[point]
    ratio = shown / np.maximum(model, 1e-3 * predicted.mean() + 1e-300)
    model = model * (np.median(ratio, axis=0) if len(ratio) else 1.0)
    count = len(sightings.seen)
    error = np.bincount(view, np.abs(shown - model).mean(axis=1), count)
    whole = np.bincount(view, shown.mean(axis=1), count)
    return [float(e / w) if w > 0 else None for e, w in zip(error, whole, strict=True)]
