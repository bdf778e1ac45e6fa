"""Refined poses: derivatives, outlines, gradients, prior, and captures whose truth is known."""

from __future__ import annotations

import json
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import run, write_scene

import svu_mi as svu
from svu_mi import scenes
from svu_mi.calibration.poses.outline_errors import outline_equations
from svu_mi.calibration.poses.pose_equations import (
    WIDEST,
    PoseEquations,
    moved_sensor,
    pixel_derivatives,
)
from svu_mi.calibration.poses.refine_poses import outline_note
from svu_mi.calibration.poses.texture_errors import SWITCHES, gradient_samples, texture_equations
from svu_mi.capture.mesh import arrays
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import (
    bounding_sphere,
    changed_sensor,
    describe,
    projected,
    sphere_sensors,
)


@pytest.fixture(scope="module")
def sound():
    """The vase, 16 photographs with masks. Read only."""
    return svu.render_capture(
        scenes.path("vase"), spp=36, views=16, resolution=(112, 96), defines={"light": "window"}
    )


def distances(capture):
    center, _ = bounding_sphere(capture.shape)
    return np.array([np.linalg.norm(to_world(s)[:3, 3] - center) for s in capture.sensors])


def shaken(capture, degrees):
    """Move cameras at random, by rotations and translations of the same effect."""
    motions = np.random.default_rng(3).normal(size=(capture.count, 6)) * np.radians(degrees)
    moved = map(moved_sensor, capture.sensors, motions / np.sqrt(3), distances(capture))
    return replace(capture, sensors=tuple(moved))


def off(capture, truth):
    """Rms distance of vertices in the photographs of two captures, in pixels."""
    points = arrays(truth.shape).positions[::7]
    shifts = [projected(a, points)[0] - projected(b, points)[0]
              for a, b in zip(capture.sensors, truth.sensors, strict=True)]  # fmt: skip
    return float(np.sqrt(np.square(shifts).sum(axis=-1).mean()))


@pytest.mark.parametrize("axis", range(6))
def test_derivatives_of_pixels_are_those_of_projection(axis):
    shape = mi.load_dict({"type": "sphere", "center": [0.3, 0.1, -0.2], "radius": 0.7})
    sensor = sphere_sensors(shape, 5, (300, 200))[3]
    points = np.random.default_rng(1).random((9, 3))
    step = 1e-4 * np.eye(6)[axis]
    ends = [projected(moved_sensor(sensor, sign * step, 2.5), points)[0] for sign in (1, -1)]
    expected = (ends[0] - ends[1]) / 2e-4
    found = pixel_derivatives(sensor, points, 2.5)[..., axis]
    np.testing.assert_allclose(found, expected, atol=2e-2 * np.abs(expected).max())


def test_a_mask_that_is_wider_everywhere_moves_no_camera(sound):
    from scipy.ndimage import binary_dilation

    wide = replace(sound, masks=tuple(binary_dilation(mask, iterations=2) for mask in sound.masks))
    equations, _ = outline_equations(wide, distances(sound))
    motion, _ = equations.solve(np.zeros((16, 6)), WIDEST)
    moved = replace(sound, sensors=tuple(
        map(moved_sensor, sound.sensors, motion, distances(sound))
    ))  # fmt: skip
    assert off(moved, sound) < 0.25


def test_a_shifted_mask_is_a_shifted_outline(sound):
    """A mask that lies two pixels further right asks for that motion of the mesh, and no other."""
    shifted = replace(sound, masks=tuple(np.roll(mask, 2, axis=1) for mask in sound.masks))
    equations, distance = outline_equations(shifted, distances(sound))
    motion, _ = equations.solve(np.zeros((16, 6)), 10 * WIDEST)
    center, _ = bounding_sphere(sound.shape)
    pairs = zip(sound.sensors, motion, distances(sound), strict=True)
    steps = np.array([projected(moved_sensor(s, x, d), center[None])[0][0]
                      - projected(s, center[None])[0][0] for s, x, d in pairs])  # fmt: skip
    np.testing.assert_allclose(np.median(steps, axis=0), [2, 0], atol=0.3)
    assert 0.5 < np.median(distance) < 2  # the normals of an outline point everywhere


def test_outlines_of_all_photographs_share_kernels(sound):
    def compiled(capture):
        dr.kernel_history_clear()
        outline_equations(capture, distances(sound))
        return {kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])}

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        first = compiled(sound)
        assert 0 < len(first) <= 4
        assert compiled(shaken(sound, 0.4)) <= first


def test_photographs_without_masks_have_no_outline(sound):
    equations, distance = outline_equations(
        replace(sound, masks=(None, *sound.masks[1:])), distances(sound)
    )
    assert np.isnan(distance[0]) and np.isfinite(distance[1:]).all()
    assert not equations.matrix[0].any() and equations.matrix[1:].any(axis=(1, 2)).all()


def test_gradients_are_those_of_a_ramp(sound):
    height, width = sound.images[0].shape[:2]
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    slopes = np.array([[0.01, 0.02, 0.03], [0.05, -0.01, 0.02]], np.float32)
    ramp = (2 + x[..., None] * slopes[0] + y[..., None] * slopes[1]).astype(np.float32)
    capture = replace(sound, images=(ramp,) * 16, buffer=None)
    known = svu.estimate(capture, svu.texels(sound.mesh, (32, 32)), preset=SWITCHES)
    samples = gradient_samples(known, known.observed.seen, 0.5)
    inside = samples.cosine > 0.6
    middle = np.median(samples.gradient[inside], axis=0)
    np.testing.assert_allclose(middle, slopes, atol=1e-4)
    assert len(samples.view) > 1000
    assert set(samples.view) == set(range(16))


def test_widths_of_motions_are_learned():
    random, count, true = np.random.default_rng(0), 400, np.repeat([2e-3, 6e-3], 3)
    noise, motions = 1e-3, random.normal(size=(400, 6)) * np.repeat([2e-3, 6e-3], 3)
    matrix = np.broadcast_to(np.eye(6) / noise**2, (count, 6, 6))
    seen = motions + noise * random.normal(size=motions.shape)
    equations, widths = PoseEquations(np.array(matrix), seen / noise**2), WIDEST
    for _ in range(20):
        found, widths = equations.solve(np.zeros((count, 6)), widths)
    np.testing.assert_allclose(widths, true, rtol=0.1)
    shrunk = seen * true**2 / (true**2 + noise**2)
    np.testing.assert_allclose(found, shrunk, rtol=0.1, atol=1e-4)


@pytest.mark.slow
def test_sound_cameras_stay_and_shaken_ones_return(sound):
    assert off(svu.refine_poses(sound).capture, sound) < 0.1
    wrong = shaken(sound, 0.4)
    refined = svu.refine_poses(wrong)
    assert off(wrong, sound) > 1
    assert off(refined.capture, sound) < 0.2
    assert refined.pixels == pytest.approx(off(wrong, sound), rel=0.2)
    assert refined.outlines[1] < refined.outlines[0]
    assert refined.r2[1] > refined.r2[0] + 0.01


@pytest.mark.slow
def test_poses_stay_where_masks_mislead(sound):
    """Masks that lose the object's right third ask for wrong cameras, which predict worse."""
    cut = [mask & (np.arange(mask.shape[1]) < 0.6 * mask.shape[1]) for mask in sound.masks]
    rolled = tuple(np.roll(mask, shift, axis=(0, 1)) for mask, shift in zip(
        cut, np.random.default_rng(2).integers(-4, 5, (16, 2)), strict=True
    ))  # fmt: skip
    refined = svu.refine_poses(replace(sound, masks=rolled))
    assert refined.is_worse and refined.pixels > 1
    assert off(refined.capture, sound) == 0
    assert "Poses are kept" in refined.sentence()


def test_textures_alone_bring_a_camera_back(sound):
    sensors = list(sound.sensors)
    sensors[5] = shaken(sound, 0.4).sensors[5]
    wrong = replace(sound, sensors=tuple(sensors))
    equations = texture_equations(wrong, 64, 1.0, distances(sound))
    motion, _ = equations.solve(np.zeros((16, 6)), WIDEST)
    moved = map(moved_sensor, sensors, motion, distances(sound))
    alone = [replace(capture, sensors=(capture.sensors[5],))
             for capture in (sound, wrong, replace(sound, sensors=tuple(moved)))]  # fmt: skip
    assert off(alone[2], alone[0]) < 0.6 * off(alone[1], alone[0])


@pytest.mark.slow
def test_check_notes_cameras_that_are_off(sound):
    assert outline_note(sound) == ("note", None)
    assert outline_note(replace(sound, masks=(None,) * 16)) == ("note", None)
    verdict, note = outline_note(shaken(sound, 0.4))
    assert verdict == "note" and "Try svu refine" in note
    pixels = float(note.partition(" pixels")[0].split()[-1])
    assert pixels == pytest.approx(off(shaken(sound, 0.4), sound), rel=0.2)
    findings = [one for one in svu.check(shaken(sound, 0.4)).findings if one.question == "cameras"]
    assert [one.sentence for one in findings] == [note]


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "size"), [(1.06, "smaller"), (0.94, "larger")])
def test_check_names_a_wrong_focal_length(sound, factor, size):
    """Cameras would all have to move the same way."""
    wrong = [2 * np.degrees(np.arctan(np.tan(np.radians(describe(one)["x_fov"] / 2)) / factor))
             for one in sound.sensors]  # fmt: skip
    sensors = tuple(changed_sensor(one, x_fov=fov) for one, fov in zip(
        sound.sensors, wrong, strict=True))  # fmt: skip
    verdict, note = outline_note(replace(sound, sensors=sensors))
    assert verdict == "unclear" and f"{size} than the mesh: check the focal length" in note


@pytest.mark.slow
def test_a_copy_of_the_capture_has_the_new_poses(shot, tmp_path, capsys):
    target = tmp_path / "refined"
    assert run("refine", shot, "-o", target) == 0
    assert "Cameras were off by" in capsys.readouterr().out  # too few photographs to hold some out
    old, new = (json.loads((path / "capture.json").read_text()) for path in (shot, target))
    assert old["sensors"] != new["sensors"]
    assert [{**a, "to_world": 0} for a in old["sensors"]] == [
        {**b, "to_world": 0} for b in new["sensors"]
    ]
    for name in ("view_0000.exr", "view_0007.exr"):
        assert (target / name).read_bytes() == (shot / name).read_bytes()
    capture = svu.load_capture(target)
    assert capture.count == 8


def test_sensors_of_a_scene_are_refined_in_the_copy(tmp_path):
    """A capture.json of one line leaves the sensors to its scene."""
    folder = tmp_path / "photographs"
    svu.render_capture(write_scene(tmp_path), spp=4, folder=folder)
    record = json.loads((folder / "capture.json").read_text())
    (folder / "capture.json").write_text(json.dumps(
        {"format": "svu-capture", "scene": record["scene"], "shape": record["shape"]}
    ))  # fmt: skip
    assert run("refine", folder, "-o", tmp_path / "refined") == 0
    written = json.loads((tmp_path / "refined" / "capture.json").read_text())
    assert [one["film"] for one in written["sensors"]] == [o["film"] for o in record["sensors"]]
    assert svu.load_capture(tmp_path / "refined").count == len(record["sensors"])


def test_refine_names_what_it_needs(shot, tmp_path, capsys):
    assert run("refine", scenes.path("vase"), "-o", tmp_path / "a") == 2
    assert "not a capture folder" in capsys.readouterr().err
    few = svu.load_capture(shot)
    few = replace(few, used=(True, True, *(False,) * 6))
    with pytest.raises(svu.SvuError, match="at least 3 photographs, got 2"):
        svu.refine_poses(few)
