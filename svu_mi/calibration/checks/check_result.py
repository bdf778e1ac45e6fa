"""Results of a check."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

Question = Literal["poses", "light", "texture", "gain", "ignored"]
Verdict = Literal["fits", "wrong", "unclear", "unknown", "note"]


@dataclass(frozen=True, kw_only=True)
class ScoredHypothesis:
    """A set of corrections and its score, ``cues`` being the parts of that by name, at most 1 each.

    Scores are only comparable within one finding; no corrections = as the capture is.
    """

    fixes: tuple[str, ...]
    score: float
    cues: Mapping[str, float]

    @property
    def title(self) -> str:
        """The corrections as one phrase."""
        return " + ".join(self.fixes) if self.fixes else "as it is"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """The answer to one question about a capture.

    Attributes:
        question: ``poses`` (of cameras and mesh), ``light``, ``texture``, ``gain`` (of the
            photographs, against the light and each other) or ``ignored`` (what the scene has that
            is not accounted for).
        verdict: ``fits``; ``wrong`` (``fixes`` would put it right); ``unclear`` (something is
            wrong, or may be, but several explanations fit, or none); ``unknown`` (photographs and
            light of this kind cannot tell); ``note`` (to be known, no mistake: of ``ignored``, or
            of gains that were estimated).
        sentence: the same for people.
        fixes: the best explanation, if it is better than what the capture says.
        alternatives: others that explain the photographs as well.
        hypotheses: best first.
    """

    question: Question
    verdict: Verdict
    sentence: str
    fixes: tuple[str, ...] = ()
    alternatives: tuple[tuple[str, ...], ...] = ()
    hypotheses: tuple[ScoredHypothesis, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ViewCheck:
    """Fit of one photograph, which has an index into the capture's photographs and a name.

    Attributes:
        overlap: intersection over union of silhouette and mask; None without a mask.
        contrast: mean rank, 0 to 1, of the photograph's gradient along the outline: 0.5 is chance.
            None where the mesh is not in the picture.
        color_error: mean difference to the mesh as a diffuse object under the given light, relative
            to the mean radiance; None where it is not seen, or without a light.
    """

    view: int
    name: str
    overlap: float | None
    contrast: float | None
    color_error: float | None


@dataclass(frozen=True, kw_only=True)
class ViewMeans:
    """Means over all views of a capture, see ``ViewCheck``; None without any."""

    overlap: float | None
    contrast: float | None
    color_error: float | None

    @staticmethod
    def of(views: tuple[ViewCheck, ...]) -> ViewMeans:
        """Average over views."""
        means = {}
        for name in (each.name for each in fields(ViewMeans)):
            values = [v for v in (getattr(view, name) for view in views) if v is not None]
            means[name] = float(np.mean(values)) if values else None
        return ViewMeans(**means)


@dataclass(frozen=True, kw_only=True, repr=False)
class Check:
    """Result of a check of a capture.

    Attributes:
        views: one per photograph that is used, in the capture's order.
        corrected: the same with all suggestions applied; ``views`` itself without any.
        findings: poses, light, texture, gain and, if anything is, ignored, in this order.
        camera_axes: (4, 4), assumed by ``camera-inverse`` (``axis_hypotheses.apply_fixes``).
    """

    views: tuple[ViewCheck, ...]
    corrected: tuple[ViewCheck, ...]
    findings: tuple[Finding, ...]
    camera_axes: np.ndarray

    def __repr__(self) -> str:
        said = (f"{one.question} ({one.verdict}): {one.sentence}" for one in self.findings)
        return "\n".join([f"<Check of {len(self.views)} photographs", *said]) + ">"

    @property
    def fixes(self) -> tuple[str, ...]:
        """Names of all corrections that are suggested without reservation."""
        wrong = (finding for finding in self.findings if finding.verdict == "wrong")
        return tuple(name for finding in wrong for name in finding.fixes)

    @property
    def fits(self) -> bool:
        """Whether nothing is wrong, as far as this can be told; a note is not about a mistake."""
        return not any(finding.verdict in ("wrong", "unclear") for finding in self.findings)

    @property
    def worst(self) -> tuple[ViewCheck, ...]:
        """Views, those that fit worst first: by silhouette, then by colour."""

        def badness(view: ViewCheck) -> tuple[float, float]:
            shape = view.overlap if view.overlap is not None else view.contrast
            color = 1.0 if view.color_error is None else view.color_error
            # Silhouettes that differ by less than a tenth are put in the order of colours.
            return -round(10 * (shape or 0.0)), color

        return tuple(sorted(self.views, key=badness, reverse=True))
