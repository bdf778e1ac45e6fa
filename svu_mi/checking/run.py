"""Does a capture fit its photographs, and if not, which known mistake explains it?"""

from __future__ import annotations

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.scene import require_variant
from svu_mi.checking import verdicts
from svu_mi.checking.appearance import Texture, read_texture, texture_fit
from svu_mi.checking.apply import apply_fixes
from svu_mi.checking.frames import Frames, reduced, some
from svu_mi.checking.light import score_light
from svu_mi.checking.points import Points, Sightings, look, open_cosines, scatter_points
from svu_mi.checking.poses import score_poses
from svu_mi.checking.record import Check, Finding
from svu_mi.checking.sky import DIRECTIONS, Sky, emitter_of, is_even
from svu_mi.checking.views import check_views
from svu_mi.formats.fixes import fixes_named, turn_of
from svu_mi.progress import Progress

SIDE = 128  # pixels of the photographs that are compared
VIEWS = 40  # that colours are compared in


def check(capture: Capture, *, progress: Progress | None = None) -> Check:
    """Compare a capture with its photographs, and look for a known mistake about axes.

    Nothing of the capture is modified.

    Args:
        capture: photographs, poses, mesh and light; masks help, but need not be there.
        progress: shows what is going on.

    Raises:
        SvuEnvironmentError: no suitable Mitsuba variant is active.
        CaptureError: no photograph is used.
    """
    require_variant()
    progress = progress or Progress()
    with progress.stage("Reducing photographs"):
        small = reduced(capture, SIDE)
    findings, axes = find_mistakes(small, progress=progress)
    names = [name for one in findings if one.verdict == "wrong" for name in one.fixes]
    with progress.stage("Checking views"):
        views = corrected = check_views(small)
        if names:
            corrected = check_views(apply_fixes(small, fixes_named(names), axes))
    return Check(views=views, corrected=corrected, findings=findings, camera_axes=axes)


def find_mistakes(
    capture: Capture, *, progress: Progress | None = None
) -> tuple[tuple[Finding, Finding, Finding], np.ndarray]:
    """Try every known mistake about axes on a capture.

    First the poses of cameras and mesh, by silhouettes and by whether views agree on what they
    show; then the V axis of the texture, under any light; then the 48 ways the environment map
    could lie.

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
    if is_even(emitter):
        return (poses, verdicts.light_unknown("it is the same from everywhere"), flip), axes
    with progress.stage("Trying lights") as stage:
        sky = Sky.of(emitter, turn_of(chosen.hypothesis.fixes, "mesh"))
        cosines = open_cosines(capture.scene, points, DIRECTIONS)
        tried = score_light(sky, points, seen, cosines, texture, stage.update)
        return (poses, verdicts.judge_light(tried), flip), axes


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
