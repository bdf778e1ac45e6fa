"""Results of a check."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

Question = Literal[
    "number", "poses", "cameras", "light", "texture", "uvs", "gain", "saturation", "sources",
    "ignored",
]  # fmt: skip
Verdict = Literal["fits", "wrong", "unclear", "unknown", "note"]


@dataclass(frozen=True, kw_only=True)
class ScoredHypothesis:
    """Set of corrections, its score, and the parts of the score (``cues``, at most 1 each).

    Scores are comparable within one finding only. An empty set leaves the capture unchanged.
    """

    fixes: tuple[str, ...]
    score: float
    cues: Mapping[str, float]

    @property
    def title(self) -> str:
        """Names of the corrections, as text."""
        return " + ".join(self.fixes) if self.fixes else "as it is"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Result of one test of a capture.

    Attributes:
        question: Tested part: ``number`` (of the photographs), ``poses`` (cameras and mesh),
            ``cameras`` (small errors of their poses), ``light``, ``texture``, ``uvs`` (their
            layout), ``gain`` (of the photographs), ``saturation``, ``sources`` (of the light) or
            ``ignored`` (unsupported parts of the scene).
        verdict: ``fits``; ``wrong`` (corrected by ``fixes``, or as ``sentence`` says); ``unclear``
            (probably wrong, with several possible causes or no known cause); ``unknown`` (not
            determined by the photographs); ``note`` (information only).
        sentence: Description of the result for users.
        fixes: Best corrections, if they improve the fit.
        alternatives: Other corrections that fit equally well.
        hypotheses: Tested corrections, best first.
    """

    question: Question
    verdict: Verdict
    sentence: str
    fixes: tuple[str, ...] = ()
    alternatives: tuple[tuple[str, ...], ...] = ()
    hypotheses: tuple[ScoredHypothesis, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ViewCheck:
    """Fit of one photograph.

    Attributes:
        view: Index into the photographs of the capture.
        name: Name of the photograph.
        overlap: Intersection over union of silhouette and mask; None without a mask.
        contrast: Mean rank in [0, 1] of the image gradient along the outline; 0.5 by chance. None
            if the mesh is outside the image.
        color_error: Mean difference from a diffuse rendering under the given light, relative to the
            mean radiance; None if the object is not seen, or without a light.
    """

    view: int
    name: str
    overlap: float | None
    contrast: float | None
    color_error: float | None


@dataclass(frozen=True, kw_only=True)
class ViewMeans:
    """Means over all views (see ``ViewCheck``); None without values."""

    overlap: float | None
    contrast: float | None
    color_error: float | None

    @staticmethod
    def of(views: tuple[ViewCheck, ...]) -> "ViewMeans":
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
        views: Fit of each used photograph, in the order of the capture.
        corrected: Fit after all suggested corrections; ``views`` itself without corrections.
        findings: Findings of poses, light, texture, gain and (if any) number of photographs,
            saturation and ignored parts.
        camera_axes: (4, 4) matrix assumed by ``camera-inverse`` (see ``apply_fixes``).
        mesh_scale: Factor of the mesh that corrects its unit; 1 if the unit is correct.

    Example:
        >>> result = svu.check(capture)
        >>> result.fits, len(result.views), result.fixes
        (True, 12, ())
    """

    views: tuple[ViewCheck, ...]
    corrected: tuple[ViewCheck, ...]
    findings: tuple[Finding, ...]
    camera_axes: np.ndarray
    mesh_scale: float = 1.0

    def __repr__(self) -> str:
        said = (f"{one.question} ({one.verdict}): {one.sentence}" for one in self.findings)
        return "\n".join([f"<Check of {len(self.views)} photographs", *said]) + ">"

    @property
    def fixes(self) -> tuple[str, ...]:
        """Names of the corrections in all findings with the verdict ``wrong``."""
        wrong = (finding for finding in self.findings if finding.verdict == "wrong")
        return tuple(name for finding in wrong for name in finding.fixes)

    @property
    def fits(self) -> bool:
        """True if no finding is ``wrong`` or ``unclear``."""
        return not any(finding.verdict in ("wrong", "unclear") for finding in self.findings)

    @property
    def worst(self) -> tuple[ViewCheck, ...]:
        """Views in order of their fit, worst first: by silhouette, then by colour."""

        def badness(view: ViewCheck) -> tuple[float, float, float]:
            shape = view.overlap if view.overlap is not None else view.contrast
            color = 1.0 if view.color_error is None else view.color_error
            # Silhouettes that differ by less than 0.1 are ordered by colour.
            return -round(10 * (shape or 0.0)), color, -(shape or 0.0)

        return tuple(sorted(self.views, key=badness, reverse=True))
