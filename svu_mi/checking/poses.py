"""Where the cameras stand against the mesh: every known mistake, tried on the photographs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from svu_mi.capture import Capture
from svu_mi.checking.appearance import Texture, agreement, texture_fit
from svu_mi.checking.frames import Frames, reduced, some
from svu_mi.checking.hypotheses import Hypothesis, pose_hypotheses
from svu_mi.checking.points import Points, look
from svu_mi.checking.silhouettes import contrast, outline, overlap, silhouettes

VIEWS, SMALL = 24, 64  # that all hypotheses are tried on, and pixels of their sides
NEAR = 0.2  # a hypothesis whose silhouettes fit worse than the best by more need not be looked at
FEWEST, KEPT = 5, 12  # hypotheses whose colours are looked at
FEWER = 0.02  # of the score, that one more correction must be worth
CERTAIN = 3.0  # standard errors
AGREEING = 0.3  # least agreement of views that speaks for anything
DECISIVE = 0.1  # of the silhouettes' fit


@dataclass(frozen=True)
class PoseScore:
    """How well one hypothesis explains the photographs.

    Attributes:
        hypothesis: the corrections.
        masked: whether silhouettes are compared with masks.
        fits: (V,) per view: intersection over union with the mask, or rank of the gradient
            along the outline.
        agreement: of views about points, see ``appearance.agreement``.
        texture: correlation with the object's texture, as it is or flipped; 0 without.
        misfit: (N,) squared differences behind ``texture``, NaN for points that are not seen.
    """

    hypothesis: Hypothesis
    masked: bool
    fits: np.ndarray
    agreement: float
    texture: float
    misfit: np.ndarray

    @property
    def silhouette(self) -> float:
        """Mean over views."""
        return float(self.fits.mean())

    @property
    def cues(self) -> dict[str, float]:
        """What the score is made of, by name."""
        kind = "silhouettes" if self.masked else "edges"
        return {kind: self.silhouette, "views agree": self.agreement, "texture": self.texture}

    @property
    def total(self) -> float:
        """What hypotheses are ranked by."""
        cost = FEWER * len(self.hypothesis.fixes)
        return 2 * self.silhouette + self.agreement + max(self.texture, 0.0) - cost


def score_poses(
    capture: Capture, points: Points, texture: Texture | None, step: Callable[[int, int], None]
) -> tuple[PoseScore, ...]:
    """Try all hypotheses; best first.

    Args:
        capture: reduced photographs, to look points up in.
        points: on the object.
        texture: of the object, None if it has none.
        step: called with (hypotheses done, all of them).
    """
    frames = Frames.of(capture)
    small = Frames.of(some(reduced(capture, SMALL), VIEWS))
    hypotheses = pose_hypotheses()
    masked, judge = _judge(small)
    fits = []
    for index, hypothesis in enumerate(hypotheses):
        fits.append(judge(silhouettes(small.posed(hypothesis.relative_poses(small.poses)))))
        step(index + 1, len(hypotheses))
    means = np.array([one.mean() for one in fits])
    order = [int(i) for i in np.argsort(-means, kind="stable")]
    near = sum(means >= means.max() - NEAR)
    spread, scores = frames.spread, []
    for index in dict.fromkeys([0, *order[: max(FEWEST, min(near, KEPT))]]):
        hypothesis = hypotheses[index]
        seen = look(points, frames.posed(hypothesis.relative_poses(frames.poses)))
        best, misfit = 0.0, np.full(len(points.position), np.nan)
        if texture is not None:
            best, misfit = max(
                (texture_fit(seen, points, albedo) for albedo in (texture.albedo, texture.flipped)),
                key=lambda pair: pair[0],
            )
        views = agreement(seen, spread)
        scores.append(PoseScore(hypothesis, masked, fits[index], views, best, misfit))
    return tuple(sorted(scores, key=lambda score: -score.total))


Judge = Callable[[Sequence[np.ndarray]], np.ndarray]


def _judge(frames: Frames) -> tuple[bool, Judge]:
    """Return whether there are masks that silhouettes can be compared with, and the comparison."""
    pairs = [(k, mask) for k, mask in enumerate(frames.masks) if mask is not None and mask.any()]
    if len(pairs) >= min(frames.views.number, 3):
        return True, lambda seen: np.array([overlap(seen[view], mask) for view, mask in pairs])
    ranks = [contrast(image) for image in frames.radiance]
    return False, lambda seen: np.array(
        [outline_contrast(*pair) or 0.0 for pair in zip(seen, ranks, strict=True)]
    )


def outline_contrast(seen: np.ndarray, rank: np.ndarray) -> float | None:
    """Return the mean rank of the gradient along an outline, None without one."""
    edge = outline(seen)
    return float(rank[edge].mean()) if edge.any() else None


def clearly_better(one: PoseScore, other: PoseScore) -> bool:
    """Return whether a hypothesis is better than another beyond chance, and in no way worse.

    Much better silhouettes decide alone: a shiny object agrees less between views than whatever
    is behind it.
    """
    for better, worse in ((one, other), (other, one)):
        closer = better.fits - worse.fits
        if closer.mean() > DECISIVE and certain(closer):
            return better is one
    return any(_gains(one, other)) and not any(_gains(other, one))


def _gains(one: PoseScore, other: PoseScore) -> tuple[bool, bool, bool]:
    """Whether silhouettes, agreement of views and texture speak for one against another."""
    closer = one.silhouette - other.silhouette
    shapes = closer > 0.005 and 1 - other.silhouette > 1.3 * (1 - one.silhouette)
    shapes = shapes if one.masked else closer > 0.015
    shapes &= certain(one.fits - other.fits)
    # Little agreement says little: of something flat or shiny, the background agrees more.
    views = one.agreement > max(AGREEING, other.agreement + 0.15, 1.5 * other.agreement)
    known = np.isfinite(one.misfit) & np.isfinite(other.misfit)
    colors = one.texture - other.texture > 0.015
    colors &= certain((other.misfit - one.misfit)[known])
    return bool(shapes), bool(views), bool(colors)


def certain(differences: np.ndarray) -> bool:
    """Return whether the mean of differences is above 0 beyond chance."""
    if len(differences) < 4:
        return bool(len(differences) and differences.min() > 0)
    error = differences.std(ddof=1) / np.sqrt(len(differences))
    return bool(differences.mean() > CERTAIN * error)


def simplest(scores: Sequence[PoseScore]) -> tuple[PoseScore, list[PoseScore]]:
    """Choose among the hypotheses that none is clearly better than: that with fewest corrections.

    A symmetric object looks the same with a mirror or a turn more, which nobody needs.

    Args:
        scores: best first.

    Returns:
        The choice, and others that are as good and as simple, or need a single correction.
    """
    equal = [score for score in scores if not clearly_better(scores[0], score)]
    chosen = min(equal, key=lambda score: len(score.hypothesis.fixes))
    names = chosen.hypothesis.names
    others = [score for score in equal if len(score.hypothesis.fixes) <= max(len(names), 1)]
    return chosen, [score for score in others if score.hypothesis.names != names]
