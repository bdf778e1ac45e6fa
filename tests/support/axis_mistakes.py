"""Mistakes about axes, and what a check has made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from svu_mi.calibration.checks.axis_hypotheses import apply_fixes
from svu_mi.calibration.checks.check_result import Finding
from svu_mi.capture.capture import Capture
from svu_mi.capture.importers.axis_fixes import FIXES, AxisFix, find_fixes, fix_rotation


@dataclass(frozen=True)
class Case:
    """A mistake.

    Attributes:
        fixes: that put it right, in this order.
        camera_axes: of the file, for ``camera-inverse``.
    """

    fixes: tuple[str, ...] = ()
    camera_axes: np.ndarray = field(default_factory=lambda: np.eye(4))

    @property
    def group(self) -> str:
        """Kind of the mistake, as the tables have it."""
        kinds = list(dict.fromkeys(FIXES[name].kind for name in self.fixes))
        return " and ".join(kinds) if kinds else "nothing wrong"

    def made(self, capture: Capture) -> Capture:
        """Return a right capture with this mistake in it."""
        for fix in reversed(find_fixes(self.fixes)):
            capture = spoil(capture, fix, self.camera_axes)
        return capture


def spoil(capture: Capture, fix: AxisFix, camera_axes: np.ndarray | None = None) -> Capture:
    """Return the capture as it is when the mistake was made that ``fix`` corrects.

    Args:
        capture: one in which all axes are right.
        fix: the correction that will be called for.
        camera_axes: see ``apply_fixes``.
    """
    mistake = replace(fix, matrix=None if fix.matrix is None else fix.matrix.T)
    return apply_fixes(capture, [mistake], np.eye(4) if camera_axes is None else camera_axes)


CASES = (
    Case(),
    *(Case((name,)) for name in FIXES),
    Case(("light-x90", "light-turn-90")),  # a Blender map read as Mitsuba's
    Case(("light-turn-270", "light-x270")),  # the other way round
    Case(("camera-x180", "light-x90", "light-turn-90")),
    Case(("mesh-x90", "light-turn-180")),
)


def outcome(findings: Sequence[Finding], case: Case) -> str:
    """Return "right", "among several", "silent" or "misled": what a check has said of a case."""
    said = [name for one in findings if one.verdict == "wrong" for name in one.fixes]
    unsure = [one for one in findings if one.verdict == "unclear"]
    if not unsure:
        if same(said, case.fixes):
            return "right"
        return "misled" if said else "silent"
    for one in unsure:
        if any(same([*said, *words], case.fixes) for words in (one.fixes, *one.alternatives)):
            return "among several"
    return "misled" if any(name not in case.fixes for name in said) else "silent"


def same(names: Sequence[str], others: Sequence[str]) -> bool:
    """Return whether corrections come to the same, whatever they are called."""
    ours, theirs = find_fixes(names), find_fixes(others)
    is_light_same = np.allclose(fix_rotation(ours, "light"), fix_rotation(theirs, "light"))
    is_mesh_same = np.allclose(fix_rotation(ours, "mesh"), fix_rotation(theirs, "mesh"))
    return is_light_same and is_mesh_same and _rest(names) == _rest(others)


def _rest(names: Sequence[str]) -> set[str]:
    return {name for name in names if FIXES[name].kind in ("camera", "texture", "winding")}
