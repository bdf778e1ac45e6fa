"""Check of cameras, mesh, light and gains of a capture against its photographs."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import compress
from typing import Any

import numpy as np

from svu_mi.calibration.checks import decisions, exposure_checks
from svu_mi.calibration.checks.axis_hypotheses import apply_fixes
from svu_mi.calibration.checks.check_result import (
    Check,
    Finding,
    Question,
    Verdict,
    ViewCheck,
    ViewMeans,
)
from svu_mi.calibration.checks.envmap_orientation import normal_dependence, score_light
from svu_mi.calibration.checks.light_sources import light_shares, sentence
from svu_mi.calibration.checks.mesh_similarity import MeshSimilarity, fit_masks
from svu_mi.calibration.checks.moved_meshes import Advantage
from svu_mi.calibration.checks.pose_scores import check_views, score_poses
from svu_mi.calibration.checks.surface_samples import (
    DIRECTIONS,
    DistantLight,
    emitter_of,
    is_constant,
    open_cosines,
    read_texture,
    sample_points,
    scatter_points,
    without_emitter,
)
from svu_mi.calibration.checks.thumbnails import Thumbnails, limit_views, reduce_photographs
from svu_mi.calibration.exposure import estimate_gains
from svu_mi.calibration.light.light_estimate import FoundGains
from svu_mi.calibration.light.light_options import LightOptions
from svu_mi.calibration.light.light_summary import gain_sentences
from svu_mi.calibration.poses.refine_poses import outline_note
from svu_mi.capture import capture_folder
from svu_mi.capture.capture import Capture
from svu_mi.capture.importers.axis_fixes import find_fixes, fix_rotation
from svu_mi.capture.importers.mesh_files import LEFT_OUT
from svu_mi.capture.load_warnings import (
    MOST,
    UNMODELLED,
    back_face_share,
    faces_outward,
    too_few_for_light,
    unsupported,
)
from svu_mi.capture.mesh import arrays
from svu_mi.capture.mesh_scale import wrong_scale
from svu_mi.capture.replace_material import is_same, other_shapes
from svu_mi.capture.scene import has_lamps, is_lit, require_variant, to_world
from svu_mi.capture.up_direction import is_seen_from_above
from svu_mi.capture.uv_charts import unusable_uvs
from svu_mi.core.progress import Progress
from svu_mi.errors import SvuError, first_of
from svu_mi.geometry.texels import texels
from svu_mi.light.environment import read_environment
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate

SIDE = 128  # maximum side of the compared photographs in pixels
TEXELS = 48  # texels per side to test gains, and light from below
COMPARED = LightOptions(texels=150)  # to test gains
VIEWS = 40  # maximum number of views for comparing colours
UNLIKE = 0.15  # least distance of a photograph's overlap or contrast below the median to be named
INSIDE = 0.8  # overlap of mesh and inverted masks, from which the masks are inverted
INVERTED = (
    "The masks show the background: inverted, they overlap the mesh. Invert them (white is the "
    "object), and import again."
)
Findings = tuple[Finding, Finding, Finding]  # of poses, light and texture


def check(
    capture: Capture, *, gains: Callable[[], FoundGains] | None = None,
    progress: Progress | None = None,
) -> Check:  # fmt: skip
    """Compare a capture with its photographs, and search for wrong axes and gains.

    Args:
        capture: Photographs, poses, mesh and light; not modified. Masks are optional. Without a
            light (``load_capture(light="optional")``), only silhouettes and texture are compared.
        gains: Function that returns gains of the used photographs; called if cameras, mesh and
            light fit. If None, only large differences of gains are detected.
        progress: Display of the progress.

    Raises:
        SvuEnvironmentError: No suitable Mitsuba variant is active.
        CaptureError: No photograph is used.
        OptionError: ``capture`` is not a ``Capture``.

    Example:
        >>> svu.check(capture, gains=lambda: gains).fits
        True
    """
    require_variant()
    progress = progress or Progress()
    with progress.stage("Reducing photographs"):
        small = reduce_photographs(capture, SIDE)
    scaled, scale, axial, axes = _find_mistakes(capture, small, progress)
    off = _axes_are_off(axial)
    if gains is None or off:
        with progress.stage("Comparing gains"):
            gain = compare_gains(capture, small, axial)
    else:
        gain = _gain_finding(capture, small, gains)
    over = () if off else _saturated(capture, small)
    sources = () if off else _sources(capture, small)
    odd: tuple[Finding, ...] = ()
    if axial[1].verdict == "fits":
        with progress.stage("Predicting held-out photographs"):
            found = _estimated(small, exposure_checks.unit_of(capture, small))
        odd = _findings("cameras", "unclear", found.odd_sentence if found else None)
        is_alone = not other_shapes(capture.scene, capture.shape)
        if found and is_alone and is_seen_from_above(capture):
            sources = _missing(found) or sources
    few = None if is_lit(capture) else too_few_for_light(sum(capture.used))
    number = _findings("number", "unclear", few)
    with progress.stage("Checking views"):
        views = corrected = check_views(small)
        masked = any(view.overlap is not None for view in views)
        unlike = _unlike(views, masked)  # by masks it is certain, by contrast a guess
        strange = (unlike or odd) if masked else (odd or unlike)
        cameras = () if off else strange or _findings("cameras", *outline_note(capture))
        uvs = _findings("uvs", "wrong", unusable_uvs(arrays(capture.mesh), "The mesh"))
        others = (*number, *uvs, *over, *sources, *_ignored(capture))
        findings = (*axial, *cameras, gain, *others)
        names = [name for one in findings if one.verdict == "wrong" for name in one.fixes]
        if names or scale != 1:
            corrected = check_views(apply_fixes(scaled, find_fixes(names), axes))
    return Check(
        views=views, corrected=corrected, findings=findings, camera_axes=axes, mesh_scale=scale
    )


def _unlike(views: tuple[ViewCheck, ...], masked: bool) -> tuple[Finding, ...]:
    """Return a finding if single outlines fit the photographs much less than the others."""
    fits = {view.name: view.overlap if masked else view.contrast for view in views}
    known = {name: fit for name, fit in fits.items() if fit is not None}
    usual = float(np.median(list(known.values()) or [0.0]))
    odd = [name for name, fit in known.items() if fit < usual - UNLIKE]
    cue = "overlap with the mask" if masked else "contrast along the outline"
    return _findings("cameras", "unclear", None if not odd else (
        f"The {cue} is {usual:.2f}, but at most {max(known[name] for name in odd):.2f} in "
        f"{first_of(odd, 5)}: check whether photograph, mask and pose belong together, or were "
        "exchanged."
    ))  # fmt: skip


def _find_mistakes(
    capture: Capture, small: Capture, progress: Progress
) -> tuple[Capture, float, Findings, np.ndarray]:
    """Test unit and axes; return the reduced capture with a corrected unit, and the findings."""
    wrong = wrong_scale(arrays(capture.shape).positions, capture.used_sensors)
    factor = wrong.factor if wrong else None
    scaled = small if factor is None else MeshSimilarity(factor).apply(small)
    (poses, light, texture), axes = find_axis_mistakes(scaled, progress=progress)
    if wrong:
        description = None if capture.source is None else capture_folder.read(capture.source)
        sentence = wrong.sentence(description.mesh_scale if description else None)
        poses = decisions.with_wrong_scale(poses, sentence, corrected=factor is not None)
    elif poses.verdict == "unclear" and not poses.fixes:
        if _masks_are_inverted(small):
            poses = replace(poses, verdict="wrong", sentence=INVERTED)
        elif fit := fit_masks(small):
            poses = replace(poses, sentence=f"{poses.sentence}{fit.sentence}")
    return scaled, factor or 1.0, (poses, light, texture), axes


def _masks_are_inverted(capture: Capture) -> bool:
    """Return whether the masks show the background instead of the object."""
    masks = tuple(None if mask is None else ~mask for mask in capture.masks)
    overlap = ViewMeans.of(check_views(replace(capture, masks=masks))).overlap
    return overlap is not None and overlap > INSIDE


def find_axis_mistakes(
    capture: Capture, *, progress: Progress | None = None
) -> tuple[Findings, np.ndarray]:
    """Test all known axis mistakes on a capture, whose photographs may be reduced.

    The order is: mesh inside out; poses of cameras and mesh, by silhouettes and agreement of
    views; V axis of the texture, without the light; the 48 orientations of the environment map.

    Returns:
        Findings of poses, light and texture, and the (4, 4) camera axes for ``camera-inverse``.
    """
    require_variant()
    progress = progress or Progress()
    capture = limit_views(reduce_photographs(capture, SIDE), VIEWS)
    eyes = [to_world(sensor)[:3, 3] for sensor in capture.used_sensors]
    mesh = arrays(capture.shape)
    behind = back_face_share(capture.scene, mesh, eyes)
    if behind < MOST or faces_outward(mesh):  # or the cameras are inside
        return _find_axis_mistakes(capture, progress)
    turned = apply_fixes(capture, find_fixes([decisions.INSIDE_OUT]))
    (poses, light, flip), axes = _find_axis_mistakes(turned, progress)
    if poses.verdict == "unclear" and not poses.fixes:  # the cameras may be inside the mesh
        return _find_axis_mistakes(capture, progress)
    return (decisions.with_inside_out(poses, behind), light, flip), axes


def _find_axis_mistakes(capture: Capture, progress: Progress) -> tuple[Findings, np.ndarray]:
    """Test axis mistakes on a capture whose mesh faces outward."""
    points = scatter_points(capture.shape)
    texture = read_texture(capture, points)
    with progress.stage("Testing poses") as stage:
        scores = score_poses(capture, points, texture, stage.update)
        poses, chosen = decisions.decide_poses(scores)
        if not chosen.masked and (poses.fixes or poses.verdict == "fits"):
            advantage = Advantage.of(capture, points, chosen.hypothesis)
            poses = poses if advantage.is_clear else decisions.fits_anywhere(poses, advantage)
    axes = chosen.hypothesis.camera_axes
    if poses.verdict == "unclear" and not poses.fixes:
        reason = "cameras and mesh must fit first"
        flip = decisions.unknown("texture", f"V cannot be tested: {reason}")
        return (poses, decisions.unknown("light", reason), flip), axes
    frames = Thumbnails.of(capture)
    seen = sample_points(points, frames.posed(chosen.hypothesis.relative_poses(frames.poses)))
    with progress.stage("Testing textures"):
        if texture is None:
            reason = "The mesh has no texture to compare"
            flip = decisions.unknown("texture", reason)
        else:
            flip = decisions.decide_texture(*texture.fits(seen, points))
            texture = texture.turned() if flip.verdict == "wrong" else texture
    emitter = emitter_of(capture)
    if emitter is None:
        return (poses, decisions.unknown("light", without_emitter(capture)), flip), axes
    cosines = open_cosines(capture.scene, points, DIRECTIONS)
    if is_constant(emitter):
        light = decisions.decide_constant_light(normal_dependence(points, seen, cosines))
    else:
        with progress.stage("Testing lights") as stage:
            sky = DistantLight.of(emitter, fix_rotation(chosen.hypothesis.fixes, "mesh"))
            light = decisions.decide_light(
                score_light(sky, points, seen, cosines, texture, stage.update)
            )
    return (poses, light, flip), axes


def _axes_are_off(axial: Sequence[Finding]) -> bool:
    """Return whether axes may be wrong, which prevents other comparisons."""
    return any(one.verdict in ("wrong", "unclear") for one in axial)


def _gain_finding(capture: Capture, small: Capture, find: Callable[[], FoundGains]) -> Finding:
    """Return a finding from gains estimated by ``find``, given correct axes."""
    try:
        gains = find()
    except SvuError as error:
        return decisions.unknown("gain", str(error).rstrip("."))
    emitter, excess = emitter_of(capture), None
    if emitter is not None:
        excess = _excess(capture, small, emitter)
    sentences = gain_sentences(gains, capture)
    return decisions.report_gains(excess, gains, sentences, recorded=_are_recorded(capture))


def _are_recorded(capture: Capture) -> bool:
    """Return whether the photographs were divided by recorded exposures that differ."""
    return capture.exposures_known and len(set(capture.exposures)) > 1


def _excess(capture: Capture, small: Capture, emitter: Any) -> exposure_checks.Excess | None:
    """Compare the photographs with a white surface; None if too few points are reliable."""
    points = scatter_points(small.shape)
    arriving = exposure_checks.Irradiance.of(small.scene, points, read_environment(emitter))
    unit = exposure_checks.unit_of(capture, small)
    samples = sample_points(points, Thumbnails.of(small))
    return exposure_checks.excess_of(samples, points, arriving, unit)


def compare_gains(capture: Capture, small: Capture, axial: Sequence[Finding]) -> Finding:
    """Check the gains of photographs relative to the light, and to each other.

    Args:
        capture: Capture with the original photographs.
        small: Capture with reduced photographs.
        axial: Findings of axes; if axes may be wrong, gains are ``unknown``.
    """
    emitter = emitter_of(capture)
    if emitter is None:
        recorded = _are_recorded(capture)
        known = "the recorded exposures are used, and " if recorded else ""
        few = too_few_for_light(sum(capture.used)) is not None
        otherwise = "take more photographs" if few else "use --gains estimate"
        advice = "--gains estimate tests them" if recorded else otherwise
        if has_lamps(capture):
            advice = "their gains have to be known"
        return decisions.unknown("gain", f"{known}{without_emitter(capture)}; {advice}")
    if _axes_are_off(axial):
        return decisions.unknown("gain", "cameras, mesh and light must fit first")
    excess, gains = _excess(capture, small, emitter), None
    names = list(compress(small.names, small.used))
    if len(names) >= decisions.FEWEST_VIEWS:
        try:
            gains = estimate_gains(small, texels(small.mesh, TEXELS), COMPARED)
        except SvuError as error:  # such as no point in enough photographs
            return decisions.unknown("gain", str(error).rstrip("."))
    return decisions.decide_gains(excess, gains, names)


def _findings(question: Question, verdict: Verdict, sentence: str | None) -> tuple[Finding, ...]:
    """Return a finding, or an empty tuple without a sentence."""
    return (Finding(question=question, verdict=verdict, sentence=sentence),) if sentence else ()


def _saturated(capture: Capture, small: Capture) -> tuple[Finding, ...]:
    """Return a finding if much of the object is saturated, or an empty tuple."""
    share = exposure_checks.saturated_share(capture, small) if capture.clipped else 0.0
    return _findings("saturation", "unclear", exposure_checks.saturation_sentence(share))


def _sources(capture: Capture, small: Capture) -> tuple[Finding, ...]:
    """Return a note on the sources of the light, or an empty tuple without a light."""
    if capture.flash is not None or not capture.scene.emitters():
        return ()
    points = scatter_points(small.shape)
    shown, known = sample_points(points, Thumbnails.of(small)).typical()
    shown *= np.where(known, exposure_checks.unit_of(capture, small), np.nan)[:, None]
    shares = light_shares(capture, points, shown)
    return _findings("sources", "note", sentence(shares))


def _estimated(small: Capture, unit: float) -> Estimate | None:
    """Return an estimate of few texels and photographs; None without any texel."""
    small = limit_views(small, VIEWS)
    images = tuple(image * np.float32(unit) for image in small.images)
    try:
        return estimate(replace(small, images=images), texels(small.mesh, TEXELS))
    except SvuError:  # such as photographs without any texel
        return None


def _missing(result: Estimate) -> tuple[Finding, ...]:
    """Return a finding if the photographs contain light from a missing shape below the object."""
    found, plane = result.prediction, result.observed and result.observed.plane
    if found is None or found.cause != "surroundings":
        return ()
    return _findings(
        "sources", "unclear",
        "A shape that touches the lowest points of the object seems to be missing, such as a "
        "table: it shades the object or is mirrored in it. Add it to the scene, or import again "
        f"with --table 0 --table-albedo {'A' if plane is None else f'{plane:g}'}.",
    )  # fmt: skip


def _ignored(capture: Capture) -> tuple[Finding, ...]:
    """Return a note about ignored parts of the scene or import, or an empty tuple."""
    # Materials of joined shapes are known to the loader only.
    loaded = [sentence for sentence in capture.warnings if UNMODELLED in sentence]
    own = is_same(capture.mesh, capture.shape)
    found = unsupported(capture.scene, capture.shape, own_uvs=own)
    notes = list(dict.fromkeys([*found, *loaded]))
    description = None if capture.source is None else capture_folder.read(capture.source)
    said = description.imported.get("notes") if description else None
    notes += [n for n in said if str(n).endswith(LEFT_OUT)] if isinstance(said, list) else []
    return _findings("ignored", "note", " ".join(notes))
