"""Does a capture fit its photographs, and if not, which known mistake explains it?"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.scene import find_environment, require_variant
from svu_mi.checking import verdicts
from svu_mi.checking.appearance import Texture, read_texture, texture_fit
from svu_mi.checking.apply import apply_fixes
from svu_mi.checking.frames import Frames, reduced
from svu_mi.checking.light import score_light
from svu_mi.checking.points import Points, look, scatter_points
from svu_mi.checking.poses import PoseScore, evenly, score_poses
from svu_mi.checking.record import Check, Finding
from svu_mi.checking.sky import Sky, open_cosines
from svu_mi.checking.views import SIDE, check_views
from svu_mi.formats.fixes import fixes_named
from svu_mi.light.environment import read_environment
from svu_mi.progress import Progress

SMALL = 64  # pixels of the photographs that all hypotheses are tried on
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
    progress = progress or Progress()
    findings, axes = find_mistakes(capture, progress=progress)
    names = [name for one in findings if one.verdict == "wrong" for name in one.fixes]
    with progress.stage("Checking views"):
        views = corrected = check_views(capture)
        if names:
            corrected = check_views(apply_fixes(capture, fixes_named(names), axes))
    return Check(views=views, corrected=corrected, findings=findings, camera_axes=axes)


def find_mistakes(
    capture: Capture, *, progress: Progress | None = None
) -> tuple[tuple[Finding, Finding, Finding], np.ndarray]:
    """Try every known mistake about axes on a capture.

    First the poses of cameras and mesh, by silhouettes and by whether views agree on what they
    show; then the V axis of the texture, under any light; then the 48 ways the environment map
    could lie.

    Args:
        capture: see ``check``.
        progress: shows what is going on.

    Returns:
        The findings about poses, light and texture, and the (4, 4) camera axes that a
        ``camera-inverse`` among them has assumed.
    """
    require_variant()
    progress = progress or Progress()
    with progress.stage("Reducing photographs"):
        frames, small = reduced(capture, SIDE), reduced(capture, SMALL)
        frames = frames.some(evenly(frames.count, VIEWS))
    points = scatter_points(capture.shape)
    texture = read_texture(capture, points)
    with progress.stage("Trying poses") as stage:
        scores = score_poses(capture, frames, small, points, texture, stage.update)
        poses, chosen = verdicts.judge_poses(scores)
    frames = frames.posed(chosen.hypothesis.relative_poses(frames.poses))
    if poses.verdict == "unclear" and not poses.fixes:
        reason = "cameras and mesh have to fit first"
        light = verdicts.light_unknown(reason)
        flip = verdicts.texture_unknown(f"Nothing can be said of V: {reason}")
        return (poses, light, flip), chosen.hypothesis.camera_axes
    with progress.stage("Trying textures"):
        flip, texture = _texture(capture, frames, points, texture)
    with progress.stage("Trying lights") as stage:
        light = _light(capture, frames, points, texture, chosen, stage.update)
    return (poses, light, flip), chosen.hypothesis.camera_axes


def _texture(
    capture: Capture, frames: Frames, points: Points, texture: Texture | None
) -> tuple[Finding, Texture | None]:
    """Decide on the V axis; return the texture the way it fits."""
    if texture is None:
        reason = "The object has no texture, so nothing depends on the V axis"
        return verdicts.texture_unknown(reason), None
    seen = look(capture, points, frames)
    fits = [texture_fit(seen, points, albedo) for albedo in (texture.albedo, texture.flipped)]
    found = verdicts.judge_texture(*fits)
    return found, texture.turned() if found.verdict == "wrong" else texture


def _light(
    capture: Capture, frames: Frames, points: Points, texture: Texture | None,
    chosen: PoseScore, step: Callable[[int, int], None],
) -> Finding:  # fmt: skip
    emitter = find_environment(capture.scene, str(capture.source or "scene"))
    if emitter.class_name() == "ConstantBackgroundEmitter":
        return verdicts.light_unknown("it is the same from everywhere")
    turn = np.eye(3)
    for fix in chosen.hypothesis.fixes:
        if fix.kind == "mesh" and fix.matrix is not None:
            turn = fix.matrix @ turn
    sky = Sky.of(read_environment(emitter), turn)
    seen = look(capture, points, frames)
    arriving = open_cosines(capture.scene, points)
    return verdicts.judge_light(score_light(sky, points, seen, arriving, texture, step))
