"""Refinement of camera poses: outlines first, then textures, from coarse to fine."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from svu_mi.calibration.poses.outline_errors import outline_equations
from svu_mi.calibration.poses.pose_equations import WIDEST, moved_sensor
from svu_mi.calibration.poses.texture_errors import texture_equations
from svu_mi.capture.capture import Capture
from svu_mi.capture.mesh import arrays
from svu_mi.capture.scene import require_light, require_variant, to_world
from svu_mi.capture.sensors import bounding_sphere, projected
from svu_mi.core.arrays import evenly_spaced
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError
from svu_mi.geometry.texels import texels
from svu_mi.pipeline import estimate

Round = tuple[int, float]

OUTLINES = 3  # rounds with outlines only
COARSE = ((32, 2.0), (32, 2.0), (64, 1.0), (64, 1.0))  # texels per side and spread, without masks
FINE = ((128, 0.5), (128, 0.5))
STEPS, LAST = 4, 8  # steps of the EM algorithm in a round, and in the last one
POINTS = 1000  # vertices whose motion in pixels is measured
FEWEST = 3  # cameras
UNCERTAIN = 0.003  # differences of R^2 that say nothing
COMMON = 0.015  # mean log distance by which all cameras move if the object has another size
NOTED, CLOSER = 0.3, 0.9  # least motion [pixels] and largest ratio of distances of a note


@dataclass(frozen=True, kw_only=True)
class RefinedPoses:
    """Cameras that were moved so that outlines and textures agree with the photographs.

    Attributes:
        capture: the capture with moved cameras; photographs that are not used keep their poses.
        moved: (V,), rms motion of the object in each used photograph, in pixels.
        outlines: rms distance between the outlines of masks and mesh before and after, in pixels;
            NaN without masks.
        r2: R^2 of held-out photographs before and after; NaN with fewer than 12 photographs. If it
            decreases, cameras are not moved.
        odd: names photographs that are predicted much worse than others; empty if there are none.

    Example:
        >>> refined = svu.refine_poses(svu.load_capture("capture", views=[0, 4, 8]))
        >>> len(refined.moved), refined.sentence()[:20]
        (3, 'Cameras were off by ')
    """

    capture: Capture
    moved: np.ndarray
    outlines: tuple[float, float]
    r2: tuple[float, float] = (np.nan, np.nan)
    odd: str = ""

    @property
    def is_worse(self) -> bool:
        """True if held-out photographs are predicted worse."""
        return self.r2[1] < self.r2[0] - UNCERTAIN

    @property
    def pixels(self) -> float:
        """Rms motion of the object over all used photographs, in pixels."""
        return float(np.sqrt(np.mean(np.square(self.moved))))

    def sentence(self) -> str:
        """Return a sentence with the motion, outlines if there are masks, and R^2."""
        most, r2 = self.moved.max(), "R^2 {:.3f} before, {:.3f} after".format(*self.r2)
        if self.is_worse:
            return (
                f"Poses are kept: moved by {self.pixels:.2g} pixels, they would predict held-out "
                f"photographs worse ({r2}). Perhaps masks or mesh are wrong: see svu check."
            )
        parts = [f"Cameras were off by {self.pixels:.2g} pixels (rms; at most {most:.2g})"]
        if np.isfinite(self.outlines[0]):
            parts.append("outlines by {:.2g} before, {:.2g} pixels after".format(*self.outlines))
        if np.isfinite(self.r2[0]):
            parts.append(f"held-out photographs are predicted with {r2}")
        return " ".join(filter(None, [f"{'; '.join(parts)}.", self.odd]))


def refine_poses(capture: Capture, progress: Progress | None = None) -> RefinedPoses:
    """Move cameras so that masks agree with the mesh's outline, and textures with each other.

    Gauss-Newton steps in six numbers per photograph (``pose_equations``). Without masks, only
    textures are used. Mesh, light and focal lengths are assumed to be right; a motion that all
    cameras share is hardly determined. Cameras are moved only if this predicts held-out photographs
    at least as well.

    Args:
        capture: at least three used photographs; the light is needed for textures.
        progress: progress display and timings.

    Raises:
        CaptureError: fewer than three photographs are used.
        SceneError: the capture has no light.

    Example:
        >>> some = svu.load_capture("capture", views=[0, 4, 8])
        >>> svu.refine_poses(some).pixels < 0.1  # these poses were exact
        True
    """
    require_variant()
    require_light(capture)
    rounds = _rounds(capture)
    progress = progress or Progress()
    with progress.stage("Refining poses", len(rounds)) as stage:
        refined = _refined(capture, rounds, stage.update)
    with progress.stage("Predicting held-out photographs"):
        (before, _), (after, odd) = (_predicted(one) for one in (capture, refined.capture))
        refined = replace(refined, r2=(before, after), odd=odd)
    return replace(refined, capture=capture) if refined.is_worse else refined


def _predicted(capture: Capture) -> tuple[float, str]:
    """Return R^2 of held-out photographs, NaN with too few, and the sentence of odd ones."""
    found = estimate(capture, texels(capture.mesh, FINE[0][0]))
    return np.nan if found.prediction is None else found.prediction.r2, found.odd_sentence


def outline_note(capture: Capture) -> tuple[Literal["note", "unclear"], str | None]:
    """Return a sentence if outlines show that cameras are off; None if not, or without masks."""
    rounds = [one for one in _rounds(capture) if one is None]
    if not rounds or len(capture.used_sensors) < FEWEST:
        return "note", None
    refined = _refined(capture, rounds, lambda *_: None)
    before, after = refined.outlines
    if refined.pixels < NOTED or after > CLOSER * before:
        return "note", None
    farther = np.log(camera_distances(refined.capture) / camera_distances(capture))
    if abs(mean := farther.mean()) > max(COMMON, 2 * farther.std()):
        return "unclear", (
            f"All photographs show the object {'smaller' if mean > 0 else 'larger'} than the mesh: "
            "check the focal length and the size of the mesh."
        )
    return "note", (
        f"Cameras seem to be off by {refined.pixels:.2g} pixels: outlines of masks and mesh are "
        f"{before:.2g} pixels apart, and {after:.2g} with moved cameras. Try svu refine."
    )


def _refined(
    capture: Capture, rounds: Sequence[Round | None], report: Callable[[int, int], None]
) -> RefinedPoses:
    """Solve one set of equations in each round."""
    distances = camera_distances(capture)
    motion, widths, current, before = np.zeros((len(distances), 6)), WIDEST, capture, np.nan
    for number, fine in enumerate(rounds):
        equations, off = outline_equations(current, distances)
        before = _rms(off) if number == 0 else before
        if fine is not None:
            equations = equations + texture_equations(current, fine[0], fine[1], distances)
        motion, widths = equations.solve(
            motion, widths, LAST if number + 1 == len(rounds) else STEPS
        )
        current = _with_motion(capture, motion, distances)
        report(number + 1, len(rounds))
    outlines = before, _rms(outline_equations(current, distances)[1])
    return RefinedPoses(capture=current, moved=moved_pixels(capture, current), outlines=outlines)


def camera_distances(capture: Capture) -> np.ndarray:
    """Return the distances of used cameras from the object, (V,); raise for too few cameras."""
    sensors, (center, _) = capture.used_sensors, bounding_sphere(capture.shape)
    if len(sensors) < FEWEST:
        raise CaptureError(
            f"Poses are refined from at least {FEWEST} photographs, got {len(sensors)}; use the "
            "capture as it is."
        )
    return np.array([np.linalg.norm(to_world(sensor)[:3, 3] - center) for sensor in sensors])


def _rounds(capture: Capture) -> list[Round | None]:
    """Return texels per side and spread of each round; None uses outlines only."""
    bare = [mask is None for mask, used in zip(capture.masks, capture.used, strict=True) if used]
    outlines: list[Round | None] = [] if all(bare) else [None] * OUTLINES
    return outlines + ([*COARSE, *FINE] if any(bare) else []) + [*FINE]


def _with_motion(capture: Capture, motion: np.ndarray, distances: np.ndarray) -> Capture:
    """Return the capture with used cameras moved from its own poses."""
    sensors = list(capture.sensors)
    for number, index in enumerate(np.flatnonzero(capture.used)):
        sensors[index] = moved_sensor(sensors[index], motion[number], distances[number])
    return replace(capture, sensors=tuple(sensors))


def moved_pixels(before: Capture, after: Capture) -> np.ndarray:
    """Return the rms motion of vertices in each used photograph, (V,) pixels."""
    positions = arrays(before.shape).positions
    points = positions[evenly_spaced(len(positions), POINTS)]
    pairs = zip(before.used_sensors, after.used_sensors, strict=True)
    shifts = [projected(a, points)[0] - projected(b, points)[0] for a, b in pairs]
    return np.array([np.sqrt(np.square(shift).sum(axis=1).mean()) for shift in shifts])


def _rms(values: np.ndarray) -> float:
    """Return the rms of finite values; NaN without any."""
    return float(np.sqrt(np.nanmean(np.square(values)))) if np.isfinite(values).any() else np.nan
