"""Does a capture fit its photographs, and if not, which known mistake explains it?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import compress
from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture import folder as capture_folder
from svu_mi.capture.ignored import ignored
from svu_mi.capture.mesh import arrays
from svu_mi.capture.scene import require_variant, to_world
from svu_mi.capture.winding import MOST, has_front_outside, part_from_behind
from svu_mi.checking import verdicts
from svu_mi.checking.appearance import Texture, read_texture, texture_fit
from svu_mi.checking.apply import apply_fixes
from svu_mi.checking.brightness import Arriving, excess, unit_of
from svu_mi.checking.even import facing
from svu_mi.checking.frames import Frames, reduced, some
from svu_mi.checking.gains import VIEWS as FEWEST
from svu_mi.checking.gains import Samples, relative_gains
from svu_mi.checking.light import score_light
from svu_mi.checking.points import Points, Sightings, look, open_cosines, scatter_points
from svu_mi.checking.poses import score_poses
from svu_mi.checking.record import Check, Finding
from svu_mi.checking.sky import DIRECTIONS, Sky, emitter_of, is_even
from svu_mi.checking.views import check_views
from svu_mi.errors import OptionError, SvuError
from svu_mi.formats.fixes import fixes_named, turn_of
from svu_mi.formats.geometry import LEFT_OUT
from svu_mi.illumination.light_summary import gain_sentences
from svu_mi.illumination.record import FoundGains
from svu_mi.light.environment import read_environment
from svu_mi.progress import Progress

SIDE = 128  # pixels of the photographs that are compared
VIEWS = 40  # that colours are compared in
Findings = tuple[Finding, Finding, Finding]  # about poses, light and texture


def check(
    capture: Capture, *, gains: Callable[[], FoundGains] | None = None,
    progress: Progress | None = None,
) -> Check:  # fmt: skip
    """Compare a capture with its photographs, and look for a known mistake about axes.

    Nothing of the capture is modified.

    Args:
        capture: photographs, poses, mesh and light; masks help, but need not be there. Without a
            light (``load_capture(light="optional")``), silhouettes and texture are looked at.
        gains: estimates those of the photographs that are used, which is asked of it once cameras,
            mesh and light fit. Without, photographs are compared, and those told that differ by
            much.
        progress: shows what is going on.

    Raises:
        SvuEnvironmentError: no suitable Mitsuba variant is active.
        CaptureError: no photograph is used.
        OptionError: anything but a capture.
    """
    require_variant()
    if not isinstance(capture, Capture):
        raise OptionError(
            f"check(): a capture is needed, got a {type(capture).__name__}; read one with "
            "svu.load_capture(path)."
        )
    progress = progress or Progress()
    with progress.stage("Reducing photographs"):
        small = reduced(capture, SIDE)
    axial, axes = find_mistakes(small, progress=progress)
    if gains is None or _contradict(axial):
        with progress.stage("Comparing gains"):
            gain = find_gains(capture, small, axial)
    else:
        gain = _estimated(capture, small, gains)
    findings = (*axial, gain, *_ignored(capture))
    names = [name for one in findings if one.verdict == "wrong" for name in one.fixes]
    with progress.stage("Checking views"):
        views = corrected = check_views(small)
        if names:
            corrected = check_views(apply_fixes(small, fixes_named(names), axes))
    return Check(views=views, corrected=corrected, findings=findings, camera_axes=axes)


def find_mistakes(
    capture: Capture, *, progress: Progress | None = None
) -> tuple[Findings, np.ndarray]:
    """Try every known mistake about axes on a capture.

    First which side of the mesh is its front; then the poses of cameras and mesh, by silhouettes
    and by whether views agree on what they show; then the V axis of the texture, under any light;
    then the 48 ways the environment map could lie.

    Args:
        capture: see ``check``; its photographs may be reduced already.
        progress: shows what is going on.

    Returns:
        The findings about poses, light and texture, and the (4, 4) camera axes that a
        ``camera-inverse`` among them has assumed.
    """
    require_variant()
    progress = progress or Progress()
    capture = some(reduced(capture, SIDE), VIEWS)
    eyes = [to_world(sensor)[:3, 3] for sensor in capture.used_sensors]
    mesh = arrays(capture.shape)
    behind = part_from_behind(capture.scene, mesh, eyes)
    if behind < MOST or has_front_outside(mesh):  # with the cameras inside
        return _find_mistakes(capture, progress)
    turned = apply_fixes(capture, fixes_named([verdicts.INSIDE_OUT]))
    (poses, light, flip), axes = _find_mistakes(turned, progress)
    if poses.verdict == "unclear" and not poses.fixes:  # cameras may as well be within the mesh
        return _find_mistakes(capture, progress)
    return (verdicts.with_inside_out(poses, behind), light, flip), axes


def _find_mistakes(capture: Capture, progress: Progress) -> tuple[Findings, np.ndarray]:
    """Try mistakes on a capture whose mesh has its front outside."""
    points = scatter_points(capture.shape)
    texture = read_texture(capture, points)
    with progress.stage("Trying poses") as stage:
        scores = score_poses(capture, points, texture, stage.update)
        poses, chosen = verdicts.judge_poses(scores)
    axes = chosen.hypothesis.camera_axes
    if poses.verdict == "unclear" and not poses.fixes:
        reason = "cameras and mesh have to fit first"
        light = verdicts.light_unknown(reason)
        flip = verdicts.texture_unknown(f"V cannot be judged: {reason}")
        return (poses, light, flip), axes
    frames = Frames.of(capture)
    seen = look(points, frames.posed(chosen.hypothesis.relative_poses(frames.poses)))
    with progress.stage("Trying textures"):
        flip, texture = _judged_texture(seen, points, texture)
    emitter = emitter_of(capture)
    if emitter is None:
        return (poses, verdicts.light_unknown("the capture has none"), flip), axes
    cosines = open_cosines(capture.scene, points, DIRECTIONS)
    if is_even(emitter):
        return (poses, verdicts.judge_even(facing(points, seen, cosines)), flip), axes
    with progress.stage("Trying lights") as stage:
        sky = Sky.of(emitter, turn_of(chosen.hypothesis.fixes, "mesh"))
        tried = score_light(sky, points, seen, cosines, texture, stage.update)
        return (poses, verdicts.judge_light(tried), flip), axes


def _contradict(axial: Sequence[Finding]) -> bool:
    """Whether something about axes is wrong, or may be: then nothing else can be compared."""
    return any(one.verdict in ("wrong", "unclear") for one in axial)


def _estimated(capture: Capture, small: Capture, find: Callable[[], FoundGains]) -> Finding:
    """Estimate the gains of photographs whose axes fit."""
    try:
        gains = find()
    except SvuError as error:
        return verdicts.gain_unknown(str(error).rstrip("."))
    emitter, excessive = emitter_of(capture), None
    if emitter is not None:
        excessive = excess(*_under(small, emitter), unit_of(capture, small))
    return verdicts.gains_found(excessive, gains, list(gain_sentences(gains, capture)))


def _under(small: Capture, emitter: Any) -> tuple[Sightings, Points, Arriving]:
    """Return what photographs show of points, the points, and the light that arrives there."""
    points = scatter_points(small.shape)
    arriving = Arriving.of(small.scene, points, read_environment(emitter))
    return look(points, Frames.of(small)), points, arriving


def find_gains(capture: Capture, small: Capture, axial: Sequence[Finding]) -> Finding:
    """Compare the gains of photographs with the light, and with each other.

    Args:
        capture: see ``check``.
        small: the same, reduced.
        axial: what was found about axes: without the right ones, nothing can be compared.
    """
    emitter = emitter_of(capture)
    if emitter is None:
        return verdicts.gain_unknown("the capture has no light")
    if _contradict(axial):
        return verdicts.gain_unknown("cameras, mesh and light have to fit first")
    sightings, points, arriving = _under(small, emitter)
    names = list(compress(small.names, small.used))
    excessive = excess(sightings, points, arriving, unit_of(capture, small))
    if len(names) < FEWEST:
        return verdicts.judge_gains(excessive, None, names)
    sky = Sky.of(emitter, np.eye(3))
    samples = Samples.of(small.scene, points, sightings, (sky, arriving))
    return verdicts.judge_gains(excessive, relative_gains(samples), names)


def _ignored(capture: Capture) -> tuple[Finding, ...]:
    """Return a note about what is not accounted for, if scene or import have said anything."""
    notes = ignored(capture.scene, capture.shape)
    description = None if capture.source is None else capture_folder.read(capture.source)
    said = description.imported.get("notes") if description else None
    notes += [n for n in said if str(n).endswith(LEFT_OUT)] if isinstance(said, list) else []
    if not notes:
        return ()
    return (Finding(question="ignored", verdict="note", sentence=" ".join(notes)),)


def _judged_texture(
    seen: Sightings, points: Points, texture: Texture | None
) -> tuple[Finding, Texture | None]:
    """Decide on the V axis; return the texture the way it fits."""
    if texture is None:
        reason = "The object has no texture, so nothing depends on the V axis"
        return verdicts.texture_unknown(reason), None
    fits = [texture_fit(seen, points, albedo) for albedo in (texture.albedo, texture.flipped)]
    found = verdicts.judge_texture(*fits)
    return found, texture.turned() if found.verdict == "wrong" else texture
