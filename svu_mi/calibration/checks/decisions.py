"""Findings of the checks, decided from scores."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from svu_mi.calibration.checks.check_result import Finding, Question, ScoredHypothesis, Verdict
from svu_mi.calibration.checks.envmap_orientation import LightScore, NormalDependence
from svu_mi.calibration.checks.exposure_checks import Excess
from svu_mi.calibration.checks.moved_meshes import Advantage
from svu_mi.calibration.checks.pose_scores import (
    SMALL,
    PoseScore,
    differs_in_texture_only,
    is_significant,
    simplest,
)
from svu_mi.calibration.light.light_estimate import FoundGains
from svu_mi.capture.importers.axis_fixes import FIXES
from svu_mi.errors import first_of

INSIDE_OUT = "mesh-inside-out"
POOR_OVERLAP = 0.7  # minimum intersection over union of silhouettes and masks
POOR_CONTRAST, POOR_AGREEMENT = 0.6, 0.3  # minimum fit without masks
STRANGE = 0.1  # agreement of views below which photographs may belong to other cameras
# Score difference from which another orientation of the light is better. On four objects under two
# lights (16 photographs of 96 pixels, EXR and 8 bits), wrong orientations of correct captures gain
# at most 0.034; the best orientation of wrongly imported EXR captures gains at least 0.9.
LIGHT_IMPROVEMENT = 0.06
LIGHT_CERTAIN = 0.6  # then the map is of this light: on 3 objects, maps of 3 others gain < 0.54
LIGHT_MARGIN = 0.03  # smaller score differences are ties
LIGHT_RANGE = 0.2  # minimum range of the score over all orientations
LEAST_CUE = 0.1  # minimum cue that supports an orientation
ALIKE = 0.3  # minimum correlation of a texture that supports other poses
FLIP_IMPROVEMENT = 0.03  # minimum difference of the correlation with a texture
FEWEST_VIEWS = 8  # for gains: 4 views of each point
LARGEST = 0.2  # maximum accepted log gain
CERTAIN = 4.0  # significance of gains in standard deviations
COMPARABLE = 0.1  # maximum standard deviation of a log gain
NAMED = 5  # maximum number of photographs named in a sentence
UNKNOWN = {
    "light": "The orientation of the light cannot be determined: {}.",
    "texture": "{}.",
    "gain": "The gains of the photographs cannot be compared: {}.",
}


def unknown(question: Question, reason: str, table: tuple[ScoredHypothesis, ...] = ()) -> Finding:
    """Return a finding with the verdict ``unknown``."""
    sentence = UNKNOWN[question].format(reason)
    return Finding(question=question, verdict="unknown", sentence=sentence, hypotheses=table)


def decide_poses(scores: Sequence[PoseScore]) -> tuple[Finding, PoseScore]:
    """Decide on cameras and mesh.

    Args:
        scores: Scores, best first, including the hypothesis without corrections.

    Returns:
        The finding, and the hypothesis to use in other tests.
    """
    current = next(score for score in scores if not score.hypothesis.fixes)
    chosen, others = simplest(scores)
    names, fit = chosen.hypothesis.names, _fit(current)
    alternatives = tuple(dict.fromkeys(other.hypothesis.names for other in others))
    finding = partial(Finding, question="poses", hypotheses=_table(scores))
    if _is_poor(chosen):
        return finding(
            verdict="unclear",
            sentence=f"Mesh and photographs do not fit ({fit}), and no known axis mistake "
            "explains it; check the scale of mesh and poses, and that both show the same object.",
        ), current  # fmt: skip
    finding = partial(finding, alternatives=alternatives)
    if chosen is current and not current.masked and current.agreement < STRANGE:
        return finding(
            verdict="unclear", alternatives=(),
            sentence=f"Photographs hardly agree on the surface ({fit}): the object is a mirror, or "
            "they belong to other cameras; name them by the ids of their sensors.",
        ), current  # fmt: skip
    if chosen is current:
        sentence = f"Cameras and mesh fit the photographs ({fit}{_as_well(alternatives)})."
        return finding(verdict="fits", sentence=sentence), current
    if differs_in_texture_only(chosen, current):
        return _decide_by_texture(finding, chosen, current)
    if alternatives:
        return finding(
            verdict="unclear", fixes=names,
            sentence=f"Cameras and mesh do not fit the photographs ({fit}); "
            f"{_choices((names, *alternatives))} would fit equally well ({_fit(chosen)}); the "
            "object is too symmetric to decide.",
        ), chosen  # fmt: skip
    sentence = f"{_causes(names)}: {_fit(chosen)} instead of {fit}."
    return finding(verdict="wrong", fixes=names, sentence=sentence), chosen


def _decide_by_texture(
    finding: Callable[..., Finding], chosen: PoseScore, current: PoseScore
) -> tuple[Finding, PoseScore]:
    """Decide if only the texture favours other poses: a wrong texture does so, too."""
    fits = f"Cameras and mesh fit the photographs ({_fit(current)})"
    if chosen.texture < ALIKE:
        return finding(verdict="fits", sentence=f"{fits}, but the texture does not."), current
    return finding(
        verdict="unclear", fixes=chosen.hypothesis.names,
        sentence=f"{fits}, but the texture only with {_choices([chosen.hypothesis.names])} "
        f"(correlation {chosen.texture:.2f} instead of {current.texture:.2f}): the axes or the "
        "texture are wrong.",
    ), chosen  # fmt: skip


def fits_anywhere(poses: Finding, advantage: Advantage) -> Finding:
    """Return a finding of a mesh that fits no better than turned and moved ones."""
    return replace(
        poses, verdict="unclear", fixes=(), alternatives=(),
        sentence="Mesh and photographs do not fit: turned or moved, the mesh fits as well "
        f"(contrast along the outline {advantage.contrast:+.2f} at {SMALL} pixels, agreement of "
        f"views {advantage.agreement:+.2f} from the mean of these). It is probably of another "
        "object, or far from its place; give the mesh of this object, in the frame of the poses.",
    )  # fmt: skip


def with_inside_out(poses: Finding, behind: float) -> Finding:
    """Add ``mesh-inside-out`` to a finding; ``behind``: back faces / seen surface."""
    sentence = (
        f"{_causes((INSIDE_OUT,))}: {behind:.0%} of its seen surface are back faces (in a Mitsuba "
        f"scene, set flip_normals on the shape). {poses.sentence}"
    )
    return replace(
        poses, verdict="unclear" if poses.verdict == "unclear" else "wrong", sentence=sentence,
        fixes=(*poses.fixes, INSIDE_OUT),
        alternatives=tuple((*names, INSIDE_OUT) for names in poses.alternatives),
    )  # fmt: skip


def with_wrong_scale(poses: Finding, wrong: str, *, corrected: bool) -> Finding:
    """Add another unit of the mesh to a finding, of the corrected mesh if that is known."""
    certain = corrected and poses.verdict != "unclear"
    then = f" With this scale: {poses.sentence}" if corrected else ""
    return replace(
        poses, verdict="wrong" if certain else "unclear", fixes=poses.fixes if corrected else (),
        sentence=f"{wrong[0].upper()}{wrong[1:]}{then}",
    )  # fmt: skip


def _table(scores: Sequence[PoseScore | LightScore]) -> tuple[ScoredHypothesis, ...]:
    return tuple(
        ScoredHypothesis(fixes=score.hypothesis.names, score=score.total, cues=score.cues)
        for score in scores
    )


def _is_poor(score: PoseScore) -> bool:
    if score.masked:
        return score.silhouette < POOR_OVERLAP
    return score.silhouette < POOR_CONTRAST and score.agreement < POOR_AGREEMENT


def _fit(score: PoseScore) -> str:
    shape = f"contrast along the outline {score.silhouette:.2f} (chance: 0.5)"
    if score.masked:
        shape = f"silhouettes overlap by {score.silhouette:.2f}"
    return f"{shape}, views agree by {score.agreement:.2f} of 1, both at {SMALL} pixels"


def decide_texture(as_it_is: tuple[float, np.ndarray], turned: tuple[float, np.ndarray]) -> Finding:
    """Decide on the V axis of texture coordinates from two results of ``texture_fit``."""
    flip = ("texture-flip-v",)
    (plain, misfit), (flipped, misfit_flipped) = as_it_is, turned
    table = [
        ScoredHypothesis(fixes=fixes, score=fit, cues={"texture": fit})
        for fixes, fit in (((), plain), (flip, flipped))
    ]
    table.sort(key=lambda one: -one.score)
    known = np.isfinite(misfit) & np.isfinite(misfit_flipped)
    difference = (misfit - misfit_flipped)[known]
    figures = f"correlation with the photographs {plain:.2f}, flipped {flipped:.2f}"
    finding = partial(Finding, question="texture", hypotheses=tuple(table))
    if max(plain, flipped) < 0.1:
        words = "The texture does not resemble the photographs, flipped or not"
    elif flipped - plain > FLIP_IMPROVEMENT and is_significant(difference):
        return finding(verdict="wrong", fixes=flip, sentence=f"{_causes(flip)}: {figures}.")
    elif plain - flipped > FLIP_IMPROVEMENT and is_significant(-difference):
        return finding(verdict="fits", sentence=f"The texture fits the photographs ({figures}).")
    else:
        words = "The direction of V in the texture cannot be determined"
    return finding(verdict="unknown", sentence=f"{words} ({figures}).")


def decide_light(scores: Sequence[LightScore]) -> Finding:
    """Decide on the axes of the environment map.

    Args:
        scores: Scores of all 48 orientations, best first; empty if the object is not seen.
    """
    if not scores:
        return unknown("light", "too little of the object is seen")
    best, current = scores[0], next(s for s in scores if not s.hypothesis.fixes)
    table, names, figures = _table(scores), best.hypothesis.names, _light_figures(current)
    finding = partial(Finding, question="light", hypotheses=table)
    improvement = best.total - current.total
    alternatives = tuple(score.hypothesis.names for score in _indistinguishable(scores, best))
    if best.total - min(score.total for score in scores) < LIGHT_RANGE:
        return unknown("light", "it is nearly constant, or hardly affects the photographs", table)
    is_supported = _count_cues(best, current) >= 2
    if improvement > LIGHT_RANGE and not is_supported:
        # An object that faces one side does not distinguish lights on that side.
        either = _choices((names, *alternatives))
        return unknown("light", f"{either} would fit better, but only in one cue of three", table)
    if improvement <= LIGHT_IMPROVEMENT or not is_supported:
        as_good = _indistinguishable(scores, current)
        others = tuple(s.hypothesis.names for s in as_good if len(s.hypothesis.fixes) == 1)
        sentence = f"The light fits the photographs ({figures}{_as_well(others)})."
        return finding(verdict="fits", alternatives=others, sentence=sentence)
    if alternatives:
        return finding(
            verdict="unclear", fixes=names, alternatives=alternatives,
            sentence=f"The light does not fit the photographs ({figures}); "
            f"{_choices((names, *alternatives))} would fit equally well.",
        )  # fmt: skip
    if improvement < LIGHT_CERTAIN:
        return finding(
            verdict="unclear", fixes=names,
            sentence=f"The light does not fit the photographs ({figures}); {_choices([names])} "
            f"fits better ({_light_figures(best)}), but so may the map of another place.",
        )  # fmt: skip
    sentence = f"{_causes(names)}: {_light_figures(best)} instead of {figures}."
    return finding(verdict="wrong", fixes=names, sentence=sentence)


def _indistinguishable(scores: Sequence[LightScore], best: LightScore) -> list[LightScore]:
    """Return the other hypotheses that fit as well as ``best``."""
    return [s for s in scores if s is not best and s.total > best.total - LIGHT_MARGIN]


def decide_constant_light(dependence: NormalDependence | None) -> Finding:
    """Decide whether a constant light is plausible."""
    if dependence is None or not dependence.contradicts:
        return unknown("light", "it is constant")
    return Finding(
        question="light", verdict="unclear",
        sentence="The light is constant, but brightness in the photographs depends on the surface "
        f"normal, by a factor of {np.exp(2 * dependence.spread):.1f}. Unless the object is painted "
        "that way, this is not the light of the photographs; give the correct one (svu import "
        "--environment, or the emitter of the scene), or omit it.",
    )  # fmt: skip


def decide_gains(excess: Excess | None, gains: FoundGains | None, names: Sequence[str]) -> Finding:
    """Decide on the gains of photographs.

    Args:
        excess: Surface that is brighter than white; None if unknown.
        gains: Gains of V photographs under the light; None if there are too few.
        names: Names of the V photographs.
    """
    if gains is None:
        said = excess and excess.sentence()
        bright = Finding(question="gain", verdict="unclear", sentence=said or "")
        return bright if said else unknown("gain", f"there are fewer than {FEWEST_VIEWS}")
    grey = gains.logarithm.mean(axis=1)
    grey, known = grey - np.median(grey), gains.sd < COMPARABLE
    odd = np.flatnonzero(known & (np.abs(grey) > np.maximum(LARGEST, CERTAIN * gains.sd)))
    named = _odd_gains(grey, odd, names) if len(odd) else None
    sentences = list(filter(None, (excess and excess.sentence(), named)))
    if sentences:
        return Finding(question="gain", verdict="unclear", sentence=" ".join(sentences))
    if not known.any():
        return unknown("gain", "reflections are too sharp, poses too rough, or points too few")
    compared = "" if known.all() else f", of {known.sum()} that can be compared"
    sentence = f"All photographs have the same gain, to about 20 %{compared}."
    return Finding(question="gain", verdict="fits", sentence=sentence)


def report_gains(
    excess: Excess | None, gains: FoundGains, sentences: Iterable[str], *, recorded: bool
) -> Finding:
    """Return the finding of estimated gains, which ``sentences`` describe.

    ``recorded``: the photographs were divided by recorded exposures that differ.
    """
    contradicted = recorded and gains.vary
    too_bright = list(filter(None, [excess and excess.sentence()]))
    if gains.are_equal:
        parts = ["All photographs have the same gain, to about 5 %.", *too_bright]
    else:
        parts = [
            *sentences, *too_bright, *["The recorded exposures do not fit."] * contradicted,
            "Other commands divide by these gains and exclude outliers with --gains estimate, the "
            "default if neither exposures nor light are known.",
        ]  # fmt: skip
    verdict: Verdict = "fits" if gains.are_equal else "note"
    if too_bright or contradicted or gains.odd.any():
        verdict = "unclear"
    return Finding(question="gain", verdict=verdict, sentence=" ".join(parts))


def _odd_gains(logarithm: np.ndarray, odd: np.ndarray, names: Sequence[str]) -> str:
    """Return a sentence about the photographs ``odd``, whose log gains differ."""
    odd = odd[np.argsort(-np.abs(logarithm[odd]), kind="stable")]
    each = first_of([f"{names[k]} (x {np.exp(logarithm[k]):.2f})" for k in odd.tolist()], NAMED)
    subject = "One photograph has" if len(odd) == 1 else f"{len(odd)} photographs have"
    which = "it" if len(odd) == 1 else "them"
    return (
        f"{subject} a different gain: {each}; give the exposure of each "
        f"photograph (svu import --exposures, or divide its pixels by it), or exclude {which}."
    )


def _count_cues(score: LightScore, other: LightScore) -> int:
    """Count the cues that favour one score over another; a single one may be chance."""
    pairs = zip(score.cues.values(), other.cues.values(), strict=True)
    return sum(a > max(b + 0.01, LEAST_CUE) for a, b in pairs)


def _light_figures(score: LightScore) -> str:
    return f"shading correlates {score.shading:.2f}, highlights explained {score.highlights:.0%}"


def _causes(names: Sequence[str]) -> str:
    text = "; ".join(dict.fromkeys(FIXES[name].cause for name in names))
    return text[0].upper() + text[1:]


def _as_well(alternatives: Sequence[Sequence[str]]) -> str:
    if not alternatives:
        return ""
    return f"; {_choices(alternatives)} would fit as well, as for a symmetric object"


def _choices(alternatives: Sequence[Sequence[str]]) -> str:
    return " or ".join(" + ".join(names) if names else "no correction" for names in alternatives)
