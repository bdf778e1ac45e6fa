"""From scores to findings: what is said, and what is better left unsaid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from svu_mi.checking.brightness import Excess
from svu_mi.checking.even import Facing
from svu_mi.checking.gains import VIEWS, Gains
from svu_mi.checking.light import LightScore, indistinguishable
from svu_mi.checking.poses import PoseScore, certain, simplest
from svu_mi.checking.record import Finding, Hypothesis, Verdict
from svu_mi.formats.fixes import FIXES
from svu_mi.illumination.record import FoundGains

INSIDE_OUT = "mesh-inside-out"
POOR_OVERLAP = 0.7  # silhouettes that fit worse explain no masks
POOR_CONTRAST, POOR_AGREEMENT = 0.6, 0.3  # the same without masks
# Of the score, from which another way to turn the light counts as better. Four of our objects
# under two lights, 16 photographs of 96 pixels, as EXR and in 8 bits: right captures gain at most
# 0.034 by any other way; EXR captures imported wrongly gain at least 0.9 by the best one.
LIGHT_GAIN = 0.06
LIGHT_MARGIN = 0.03  # below it, two ways explain the photographs equally well
LIGHT_RANGE = 0.2  # of the score over all ways, below which nothing can be told
SPEAKING = 0.1  # least cue that speaks for a way to turn the light
FLIP_GAIN = 0.03  # of the correlation with a texture
NAMED = 5  # photographs that a sentence names
ALIKE = 0.05  # logarithm of gains that were estimated, up to which they are one


def judge_poses(scores: Sequence[PoseScore]) -> tuple[Finding, PoseScore]:
    """Decide on cameras and mesh.

    Args:
        scores: best first; the one without corrections is among them.

    Returns:
        The finding, and the hypothesis that everything else should be judged under.
    """
    current = next(score for score in scores if not score.hypothesis.fixes)
    chosen, others = simplest(scores)
    names, current_fit = chosen.hypothesis.names, _fit(current)
    found = partial(Finding, question="poses", hypotheses=_table(scores))
    alternatives = tuple(dict.fromkeys(other.hypothesis.names for other in others))
    if _is_poor(chosen):
        return found(
            verdict="unclear",
            sentence=f"Mesh and photographs do not fit ({current_fit}), and no known mistake "
            "explains it: check the scale of mesh and poses, and whether they belong together.",
        ), current  # fmt: skip
    if chosen is current:
        also = f"; {_either(alternatives)} would fit as well" if alternatives else ""
        sentence = f"Cameras and mesh fit the photographs ({current_fit}{also})."
        return found(verdict="fits", alternatives=alternatives, sentence=sentence), current
    if alternatives:
        return found(
            verdict="unclear", fixes=names, alternatives=alternatives,
            sentence=f"Cameras and mesh do not fit the photographs ({current_fit}); "
            f"{_either((names, *alternatives))} explains them equally well ({_fit(chosen)}): the "
            "object is too symmetric to tell.",
        ), chosen  # fmt: skip
    sentence = f"{_causes(names)}: {_fit(chosen)} instead of {current_fit}."
    return found(verdict="wrong", fixes=names, sentence=sentence), chosen


def with_inside_out(poses: Finding, behind: float) -> Finding:
    """Add to the finding about a mesh turned inside out that it had to be turned.

    Args:
        poses: of the mesh after that.
        behind: part of what the photographs show that was its back.
    """
    sentence = (
        f"{_causes((INSIDE_OUT,))}: {behind:.0%} of what the photographs show of it is its back "
        f"(in a Mitsuba scene, set flip_normals on the shape). {poses.sentence}"
    )
    return replace(
        poses, verdict="unclear" if poses.verdict == "unclear" else "wrong", sentence=sentence,
        fixes=(*poses.fixes, INSIDE_OUT),
        alternatives=tuple((*names, INSIDE_OUT) for names in poses.alternatives),
    )  # fmt: skip


def _table(scores: Sequence[PoseScore | LightScore]) -> tuple[Hypothesis, ...]:
    """Return scores as they are told."""
    return tuple(
        Hypothesis(fixes=score.hypothesis.names, score=score.total, cues=score.cues)
        for score in scores
    )


def _is_poor(score: PoseScore) -> bool:
    if score.masked:
        return score.silhouette < POOR_OVERLAP
    return score.silhouette < POOR_CONTRAST and score.agreement < POOR_AGREEMENT


def _fit(score: PoseScore) -> str:
    kind = "silhouettes overlap by" if score.masked else "contrast along the outline"
    return f"{kind} {score.silhouette:.2f}, views agree by {score.agreement:.2f}"


def texture_unknown(reason: str) -> Finding:
    """Return the finding that nothing can be said of V."""
    return Finding(question="texture", verdict="unknown", sentence=f"{reason}.")


def judge_texture(as_it_is: tuple[float, np.ndarray], turned: tuple[float, np.ndarray]) -> Finding:
    """Decide on the V axis of texture coordinates, by two ``texture_fit``."""
    (plain, misfit), (flipped, misfit_flipped) = as_it_is, turned
    table = [
        Hypothesis(fixes=fixes, score=fit, cues={"texture": fit})
        for fixes, fit in (((), plain), (("texture-flip-v",), flipped))
    ]
    found = partial(
        Finding, question="texture", hypotheses=tuple(sorted(table, key=lambda one: -one.score))
    )
    known = np.isfinite(misfit) & np.isfinite(misfit_flipped)
    difference = (misfit - misfit_flipped)[known]
    figures = f"correlation with the photographs {plain:.2f}, flipped {flipped:.2f}"
    if max(plain, flipped) < 0.1:
        words = "The texture does not resemble the photographs, flipped or not"
    elif flipped - plain > FLIP_GAIN and certain(difference):
        sentence = f"{_causes(('texture-flip-v',))}: {figures}."
        return found(verdict="wrong", fixes=("texture-flip-v",), sentence=sentence)
    elif plain - flipped > FLIP_GAIN and certain(-difference):
        return found(verdict="fits", sentence=f"The texture fits the photographs ({figures}).")
    else:
        words = "The direction of V in the texture cannot be determined"
    return found(verdict="unknown", sentence=f"{words} ({figures}).")


def judge_light(scores: Sequence[LightScore]) -> Finding:
    """Decide on the axes of the environment map.

    Args:
        scores: best first, all 48; none if nothing is seen of the object.
    """
    if not scores:
        return light_unknown("too little of the object is seen")
    best, current = scores[0], next(s for s in scores if not s.hypothesis.fixes)
    table = _table(scores)
    found = partial(Finding, question="light", hypotheses=table)
    gain = best.total - current.total
    near = indistinguishable(scores, best, LIGHT_MARGIN)
    alternatives = tuple(score.hypothesis.names for score in near)
    figures = _light_figures(current)
    if best.total - min(score.total for score in scores) < LIGHT_RANGE:
        return light_unknown("it is even, or the object shows too little of it", table)
    is_supported = _support(best, current) >= 2
    if gain > LIGHT_RANGE and not is_supported:
        # What faces one way only is as bright under any light of that side.
        reason = f"{_either((best.hypothesis.names, *alternatives))} would fit better, but only "
        return light_unknown(f"{reason}by one cue of three", table)
    if gain <= LIGHT_GAIN or not is_supported:
        as_good = indistinguishable(scores, current, LIGHT_MARGIN)
        others = tuple(s.hypothesis.names for s in as_good if len(s.hypothesis.fixes) == 1)
        also = f"; {_either(others)} would fit as well" if others else ""
        sentence = f"The light fits the photographs ({figures}{also})."
        return found(verdict="fits", alternatives=others, sentence=sentence)
    names = best.hypothesis.names
    if alternatives:
        return found(
            verdict="unclear", fixes=names, alternatives=alternatives,
            sentence=f"The light does not fit the photographs ({figures}); "
            f"{_either((names, *alternatives))} would fit equally well.",
        )  # fmt: skip
    sentence = f"{_causes(names)}: {_light_figures(best)} instead of {figures}."
    return found(verdict="wrong", fixes=names, sentence=sentence)


def judge_even(found: Facing | None) -> Finding:
    """Decide on a light that is the same from everywhere, which axes do not matter to."""
    if found is None or not found.contradicts:
        return light_unknown("it is the same from everywhere")
    return Finding(
        question="light", verdict="unclear",
        sentence="The light is the same from everywhere, but the photographs are brighter where "
        f"the surface faces some sides, by a factor of {np.exp(2 * found.spread):.1f}: unless the "
        "object is painted that way, this light stands in for another; give that of the "
        "photographs (svu import --environment, or the emitter of the scene).",
    )  # fmt: skip


def light_unknown(reason: str, table: tuple[Hypothesis, ...] = ()) -> Finding:
    """Return the finding that the axes of the light cannot be determined."""
    return Finding(
        question="light", verdict="unknown", hypotheses=table,
        sentence=f"The orientation of the light cannot be determined: {reason}.",
    )  # fmt: skip


def judge_gains(excess: Excess | None, gains: Gains | None, names: Sequence[str]) -> Finding:
    """Decide on the gain of the photographs.

    Args:
        excess: of all of them over the light; None if that cannot be told.
        gains: of V photographs, against each other; None if they are too few.
        names: of those.
    """
    said = [] if excess is None or excess.sentence is None else [excess.sentence]
    if gains is not None and gains.odd.any():
        said.append(_odd_gains(gains, names))
    if said:
        return Finding(question="gain", verdict="unclear", sentence=" ".join(said))
    if gains is None:
        return gain_unknown(f"there are fewer than {VIEWS}")
    if not gains.known.any():
        return gain_unknown("reflections are too sharp, poses too rough, or points too few")
    some = "" if gains.known.all() else f", of {gains.known.sum()} that can be compared"
    sentence = f"All photographs have the same gain, to about 20 %{some}."
    return Finding(question="gain", verdict="fits", sentence=sentence)


def gains_found(excess: Excess | None, gains: FoundGains, said: Sequence[str]) -> Finding:
    """Return the finding about gains that were estimated.

    Args:
        excess: of all photographs over the light, see ``judge_gains``.
        gains: of the photographs that are used.
        said: sentences about them.
    """
    too_bright = [] if excess is None or excess.sentence is None else [excess.sentence]
    verdict: Verdict = "fits"
    even = float(np.abs(gains.logarithm[~gains.odd]).max(initial=0)) <= ALIKE
    if even and not gains.odd.any():
        same = "All photographs have the same gain, to about 5 %."
        sentence = " ".join([same, *too_bright])
    else:
        sentence = " ".join([
            *said, *too_bright, "With --gains estimate, other commands divide by these gains, and "
            "leave out what does not fit.",
        ])  # fmt: skip
        verdict = "note"
    if too_bright or gains.odd.any():
        verdict = "unclear"
    return Finding(question="gain", verdict=verdict, sentence=sentence)


def _odd_gains(gains: Gains, names: Sequence[str]) -> str:
    odd = np.flatnonzero(gains.odd)
    odd = odd[np.argsort(-np.abs(gains.log[odd]), kind="stable")]
    each = [f"{names[k]} (x {np.exp(gains.log[k]):.2f})" for k in odd[:NAMED]]
    more = f" and {len(odd) - NAMED} more" if len(odd) > NAMED else ""
    subject = "One photograph has" if len(odd) == 1 else f"{len(odd)} photographs have"
    which = "it" if len(odd) == 1 else "them"
    return (
        f"{subject} another gain than the others: {', '.join(each)}{more}; give the exposure of "
        f"each photograph (svu import --exposures, or divide its pixels by it), or leave "
        f"{which} out."
    )


def gain_unknown(reason: str) -> Finding:
    """Return the finding that nothing can be said about gains."""
    sentence = f"Whether the photographs have the same gain cannot be determined: {reason}."
    return Finding(question="gain", verdict="unknown", sentence=sentence)


def _support(one: LightScore, other: LightScore) -> int:
    """Count the cues that speak for one against another; one alone may be chance."""
    pairs = zip(one.cues.values(), other.cues.values(), strict=True)
    return sum(a > max(b + 0.01, SPEAKING) for a, b in pairs)


def _light_figures(score: LightScore) -> str:
    return f"shading correlates {score.shading:.2f}, highlights explained {score.highlights:.0%}"


def _causes(names: Sequence[str]) -> str:
    text = "; ".join(dict.fromkeys(FIXES[name].cause for name in names))
    return text[0].upper() + text[1:]


def _either(alternatives: Sequence[Sequence[str]]) -> str:
    return " or ".join(" + ".join(names) if names else "no correction" for names in alternatives)
