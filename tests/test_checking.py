"""Mistakes about axes are found, named, and never invented."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from studies.conventions.cases import CASES, Case, outcome, same
from studies.conventions.photographs import before_wall, eight_bit, without_masks
from studies.conventions.run import conventions_tables
from studies.conventions.written import write

import svu_mi as svu
from svu_mi import scenes
from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.poses import sphere_sensors
from svu_mi.capture.rendering import object_mask
from svu_mi.capture.scene import to_world
from svu_mi.checking import apply_fixes, spoil
from svu_mi.checking.appearance import read_texture, texture_fit
from svu_mi.checking.frames import reduced
from svu_mi.checking.hypotheses import light_hypotheses, pose_hypotheses
from svu_mi.checking.light import score_light
from svu_mi.checking.points import look, scatter_points
from svu_mi.checking.poses import score_poses
from svu_mi.checking.record import Finding
from svu_mi.checking.run import find_mistakes
from svu_mi.checking.silhouettes import silhouettes
from svu_mi.checking.sky import Sky, open_cosines
from svu_mi.checking.verdicts import judge_light, judge_poses, judge_texture
from svu_mi.checking.views import check_views
from svu_mi.cli.main import main
from svu_mi.formats.fixes import FIXES, fixes_named
from svu_mi.formats.importing import import_capture
from svu_mi.formats.reading import read_source
from svu_mi.formats.source import ENVIRONMENT_AXES, OPENCV, OPENGL
from svu_mi.light.environment import read_environment
from svu_mi.scenes import lights, meshes
from tests.helpers import ball, memory_capture

VIEWS, FILM, SPP, POINTS = 8, (48, 36), 16, 400
SEED = 40913


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    """A quarter of the points is enough for photographs this small."""
    monkeypatch.setattr("svu_mi.checking.run.scatter_points", partial(scatter_points, count=POINTS))


def quiet(done, total):
    """No progress."""


def cluster():
    """Balls of four sizes that look different from every side, in a mirror too."""
    theta = np.linspace(0, np.pi, 13)
    profile = np.stack([np.sin(theta), np.cos(theta)], axis=-1)
    parts = []
    places = ((0, 0, 0, 0.5), (0.6, 0.15, 0, 0.28), (0.05, 0.6, 0.2, 0.22), (-0.1, -0.2, 0.65, 0.3))
    for k, (x, y, z, radius) in enumerate(places):
        low = (0.5 * (k % 2), 0.5 * (k // 2))
        ball = meshes.revolve(radius * profile, 24) + [x, y, z]
        parts.append(meshes.sheet(ball, low, (low[0] + 0.5, low[1] + 0.5)))
    points, faces, uvs = meshes.join(parts)
    return capture_mesh.make("cluster", capture_mesh.MeshArrays(points, faces, None, uvs))


def photographed(shape, light, bsdf, count=VIEWS, film=FILM):
    """A capture of a live mesh, with masks."""
    shape.set_bsdf(mi.load_dict(bsdf))
    scene = mi.load_dict(
        {"type": "scene", "integrator": {"type": "direct"}, "light": light, shape.id(): shape},
        optimize=False,
    )
    sensors = sphere_sensors(shape, count, film)
    images = [
        np.array(mi.render(scene, sensor=sensor, spp=SPP, seed=SEED + index))[..., :3]
        for index, sensor in enumerate(sensors)
    ]
    masks = tuple(object_mask(scene, shape, sensor) >= 0.999 for sensor in sensors)
    return memory_capture(scene, images, sensors, masks=masks)


def sky(picture):
    small = np.ascontiguousarray(picture[::2, ::2], np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(small)}


@pytest.fixture(scope="module")
def capture():
    """Everything right: textured, a little glossy, without symmetry, wider than high."""
    colors = np.random.default_rng(SEED).random((16, 16, 3)) ** 2 * 0.9 + 0.05
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(colors.astype(np.float32)), "raw": True}
    bsdf = {"type": "principled", "base_color": texture, "roughness": 0.35}
    return photographed(cluster(), sky(lights.window() + 0.3 * lights.studio()), bsdf)


@pytest.fixture(scope="module")
def grey_ball():
    """A ball of one colour: nothing is more symmetric."""
    shape = capture_mesh.make("ball", ball(24, 12))
    bsdf = {"type": "principled", "base_color": {"type": "rgb", "value": 0.4}, "roughness": 0.4}
    return photographed(shape, sky(lights.studio()), bsdf, count=8)


@pytest.fixture(scope="module")
def knot(tmp_path_factory):
    """A capture in a folder, with masks."""
    return svu.render_capture(
        scenes.path("knot"), 8, folder=tmp_path_factory.mktemp("knot") / "capture", views=10,
        resolution=FILM, defines={"max_depth": "2"},
    )  # fmt: skip


@pytest.fixture(scope="module")
def lit(capture):
    """What light is judged by; it does not depend on how the light lies."""
    points = scatter_points(capture.shape, POINTS)
    seen = look(capture, points, reduced(capture, 64))
    return points, seen, open_cosines(capture.scene, points), read_texture(capture, points)


def pose_finding(capture, frames=None):
    frames = reduced(capture, 48) if frames is None else frames
    points = scatter_points(capture.shape, POINTS)
    texture = read_texture(capture, points)
    scores = score_poses(capture, frames, frames, points, texture, quiet)
    return judge_poses(scores)


def light_finding(capture, lit):
    points, seen, arriving, texture = lit
    environment = read_environment(capture.scene.emitters()[0])
    scores = score_light(Sky.of(environment, np.eye(3)), points, seen, arriving, texture, quiet)
    return judge_light(scores)


INVERSE = "camera-inverse"
POSES = [case for case in CASES if case.group in ("camera", "mesh")]
POSES += [Case((INVERSE,), OPENGL), Case((INVERSE,), OPENCV)]
UNMASKED = [Case((name,)) for name in (INVERSE, "mesh-mirror")]
# Every other one: all 48 ways are tried alike, and the benchmark takes each.
LIGHTS = [case for case in CASES if case.group == "light"][::2]


def names(case):
    return "+".join(case.fixes) + ("*" if not np.array_equal(case.camera_axes, np.eye(4)) else "")


@pytest.mark.parametrize("case", POSES, ids=names)
def test_wrong_poses_are_named(capture, case):
    finding, chosen = pose_finding(case.made(capture))
    assert (finding.verdict, finding.fixes) == ("wrong", case.fixes), finding.sentence
    if case.fixes == (INVERSE,):
        np.testing.assert_array_equal(chosen.hypothesis.camera_axes, case.camera_axes)


@pytest.mark.parametrize("case", UNMASKED, ids=names)
def test_wrong_poses_are_named_without_masks(capture, case):
    """The light itself is behind the object."""
    finding, _ = pose_finding(case.made(without_masks(capture)))
    assert (finding.verdict, finding.fixes) == ("wrong", case.fixes), finding.sentence


@pytest.mark.parametrize("case", LIGHTS, ids=names)
def test_a_wrong_light_is_named(capture, lit, case):
    finding = light_finding(case.made(capture), lit)
    assert finding.verdict == "wrong", finding.sentence
    assert same(finding.fixes, case.fixes)


def test_a_map_mirrored_and_upside_down_is_named_by_what_it_comes_to(capture, lit):
    made = Case(("light-mirror", "light-flip", "light-turn-90")).made(capture)
    finding = light_finding(made, lit)
    assert same(finding.fixes, ("light-mirror", "light-flip", "light-turn-90"))


def test_a_right_capture_is_left_alone(capture):
    assert pose_finding(without_masks(capture))[0].verdict == "fits"
    findings, _ = find_mistakes(eight_bit(before_wall(capture)))
    assert [one.verdict for one in findings] == ["fits", "fits", "fits"]


def test_two_mistakes_and_a_flipped_texture_are_found_together(capture):
    case = Case(("camera-x180", "light-x90", "light-turn-90", "texture-flip-v"))
    found = svu.check(case.made(capture))
    assert not found.fits and same(found.fixes, case.fixes)
    assert np.mean([view.overlap for view in found.views]) < 0.2
    assert np.mean([view.overlap for view in found.corrected]) > 0.9
    right = [view.color_error for view in check_views(capture)]
    corrected = [view.color_error for view in found.corrected]
    np.testing.assert_allclose(corrected, right, rtol=0.05)
    assert np.mean(right) < 0.4


def test_a_wrong_mesh_leaves_the_light_with_the_cameras(capture):
    case = Case(("mesh-x90", "light-turn-180"))
    findings, _ = find_mistakes(case.made(capture))
    assert outcome(findings, case) == "right"


@pytest.mark.parametrize("fix", ["mesh-mirror", "mesh-x90", "mesh-x180"])
def test_of_a_ball_nothing_is_said_that_cannot_be_known(grey_ball, fix):
    finding, _ = pose_finding(spoil(grey_ball, FIXES[fix]))
    assert finding.verdict == "fits"  # a ball that is turned is the same ball
    assert (fix,) in finding.alternatives and "would fit as well" in finding.sentence


def test_a_camera_that_looks_away_from_a_ball_is_never_corrected_wrongly(grey_ball):
    finding, _ = pose_finding(spoil(grey_ball, FIXES["camera-x180"]))
    assert finding.fixes == ("camera-x180",) or ("camera-x180",) in finding.alternatives


def test_photographs_of_something_else_are_explained_by_nothing(capture):
    """Every photograph beside the pose of another, and a mesh of a tenth of the size."""
    shuffled = replace(
        capture,
        images=capture.images[5:] + capture.images[:5],
        masks=capture.masks[5:] + capture.masks[:5],
    )
    small = replace(FIXES["mesh-x180"], matrix=np.eye(3) * 0.1)
    finding, _ = pose_finding(apply_fixes(shuffled, [small]))
    assert finding.verdict == "unclear" and not finding.fixes
    assert "scale" in finding.sentence


def test_light_without_a_direction_cannot_be_told(capture):
    """Of a constant one nothing is asked; a gradient tells up from down, but not east from west."""
    constant = mi.load_dict({"type": "constant"})
    even = replace(capture, scene=mi.load_dict(
        {"type": "scene", "light": constant, "shape": capture.shape}, optimize=False))  # fmt: skip
    findings, _ = find_mistakes(even)
    assert findings[1].verdict == "unknown" and "everywhere" in findings[1].sentence
    overcast = photographed(cluster(), sky(lights.overcast()), {"type": "diffuse"}, count=8)
    points = scatter_points(overcast.shape, POINTS)
    seen = look(overcast, points, reduced(overcast, 48))
    sideways = spoil(overcast, FIXES["light-turn-90"])
    finding = light_finding(sideways, (points, seen, open_cosines(overcast.scene, points), None))
    assert finding.verdict in ("fits", "unknown") and not finding.fixes


def test_of_one_plane_the_light_is_not_told():
    """Highlights alone would speak for a turn of the map; they are not believed."""
    points = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    plane = capture_mesh.make("plane", capture_mesh.MeshArrays(points, faces, None, points[:, :2]))
    bsdf = {"type": "principled", "base_color": {"type": "rgb", "value": 0.3}, "roughness": 0.3}
    taken = photographed(plane, sky(lights.window()), bsdf, count=6)
    points = scatter_points(taken.shape, POINTS)
    lit = points, look(taken, points, reduced(taken, 48)), open_cosines(taken.scene, points), None
    assert light_finding(taken, lit).verdict == "fits"
    finding = light_finding(spoil(taken, FIXES["light-flip"]), lit)
    assert finding.verdict == "unknown" and "one sign" in finding.sentence


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("value", [0.0, np.nan])
def test_photographs_that_show_nothing_say_nothing(capture, value):
    """All black, or all saturated: silhouettes alone are judged, and no number is NaN."""
    few = slice(0, 4)
    blank = replace(
        capture, sensors=capture.sensors[few], masks=capture.masks[few], used=(True,) * 4,
        names=capture.names[few], exposures=(1.0,) * 4, unusable=(0,) * 4,
        images=tuple(np.full_like(image, value) for image in capture.images[few]),
    )  # fmt: skip
    assert pose_finding(spoil(blank, FIXES["camera-y180"]))[0].fixes == ("camera-y180",)
    views = check_views(blank)
    assert all(view.color_error is None for view in views)
    assert all(np.isfinite([view.overlap, view.contrast]).all() for view in views)
    with pytest.raises(svu.SvuError, match="none can be used"):
        svu.check(replace(blank, used=(False,) * 4))


def test_texture_without_likeness_is_not_judged(capture):
    points = scatter_points(capture.shape, 500)
    seen = look(capture, points, reduced(capture, 64))
    noise = np.random.default_rng(SEED).random((2, 500, 3))
    fits = tuple(texture_fit(seen, points, one) for one in noise)
    assert judge_texture(*fits).verdict == "unknown"


@pytest.mark.parametrize("name", FIXES)
def test_a_fix_undoes_its_mistake_and_changes_nothing_else(capture, name):
    before = [to_world(s) for s in capture.sensors], capture_mesh.arrays(capture.shape)
    wrong = spoil(capture, FIXES[name])
    again = apply_fixes(wrong, fixes_named([name]))
    for one in (capture, again):
        np.testing.assert_allclose([to_world(s) for s in one.sensors], before[0], atol=1e-6)
        mesh = capture_mesh.arrays(one.shape)
        np.testing.assert_allclose(mesh.positions, before[1].positions, atol=1e-6)
        np.testing.assert_allclose(mesh.uvs, before[1].uvs, atol=1e-6)
        np.testing.assert_array_equal(mesh.faces, before[1].faces)
    old, new = (read_environment(one.scene.emitters()[0]) for one in (capture, again))
    np.testing.assert_allclose(new.radiance, old.radiance, rtol=1e-5)
    np.testing.assert_allclose(new.to_local, old.to_local, atol=1e-6)
    mesh, light = capture_mesh.arrays(wrong.shape), read_environment(wrong.scene.emitters()[0])
    kept = {
        "camera": np.allclose([to_world(s) for s in wrong.sensors], before[0]),
        "mesh": np.allclose(mesh.positions, before[1].positions),
        "texture": np.allclose(mesh.uvs, before[1].uvs),
        "light": np.allclose(light.to_local, old.to_local),
    }
    assert [kind for kind, same in kept.items() if not same] == [FIXES[name].kind]


def test_turned_cameras_see_what_a_turned_mesh_shows(capture):
    """Hypotheses about the mesh move the cameras instead; a rendered mask says the same."""
    frames = reduced(capture, max(FILM))
    for fix in (FIXES["mesh-x90"], FIXES["mesh-mirror"], FIXES["camera-z180"]):
        hypothesis = next(h for h in pose_hypotheses() if h.fixes == (fix,))
        moved = frames.posed(hypothesis.relative_poses(frames.poses))
        corrected = apply_fixes(capture, [fix])
        seen = silhouettes(capture, moved)
        for one, sensor in zip(seen, corrected.sensors, strict=True):
            mask = object_mask(corrected.scene, corrected.shape, sensor) >= 0.5
            assert (one != mask).mean() < 0.01


def test_points_project_where_rays_go(capture):
    frames, points = reduced(capture, 64), scatter_points(capture.shape, 200)
    pixel, depth = frames.project(points.position)
    for view, sensor in enumerate(capture.sensors):
        it = mi.Interaction3f()
        it.p = mi.Point3f(points.position.T.astype(np.float32))
        sample, _ = sensor.sample_direction(it, mi.Point2f(0.5))
        np.testing.assert_allclose(pixel[view], np.array(sample.uv).T, atol=2e-3)
        assert (depth[view] > 0).all()


def test_every_way_to_lay_axes_is_tried_once():
    found = light_hypotheses()
    assert len({one.matrix.tobytes() for one in found}) == len(found) == 48
    assert [len(one.fixes) for one in found] == sorted(len(one.fixes) for one in found)
    for right in ENVIRONMENT_AXES.values():  # any convention that was read as any other
        for wrong in ENVIRONMENT_AXES.values():
            assert any(np.allclose(wrong @ one.matrix, right) for one in found)
    assert not pose_hypotheses()[0].fixes and len(pose_hypotheses()) == 80


@pytest.mark.filterwarnings("ignore::svu_mi.SvuWarning")
def test_the_command_says_what_is_wrong_and_how_to_mend_it(knot, tmp_path, capsys, browser):
    folder, out = tmp_path / "capture", tmp_path / "out"
    shutil.copytree(knot.source, folder)
    assert main(["check", str(tmp_path / "none"), "-o", str(out)]) == 2
    words = ["check", str(folder), "-o", str(out), "--strict"]
    assert main(words) == 0
    assert "The capture fits" in capsys.readouterr().out
    path = folder / "capture.json"
    record = json.loads(path.read_text())
    for sensor in record["sensors"]:
        sensor["to_world"] = (np.array(sensor["to_world"]) @ np.diag([1, -1, -1, 1])).tolist()
    path.write_text(json.dumps(record))
    assert main(words) == 3
    printed = capsys.readouterr().out
    assert "svu import ... --fix camera-x180" in printed and "poses (WRONG)" in printed
    record = json.loads((out / "check.json").read_text())
    assert record["fixes"] == ["camera-x180"] and not record["fits"]
    assert len(record["check"]["views"]) == 10
    for width in (1280, 400):
        shown = browser.open(out / "check.html", width)
        assert shown.requests == [] and shown.overflow == 0
        assert "--fix camera-x180" in shown.evaluate("document.body.innerText")
        # A thumbnail per view, and the light before and after.
        widths = shown.evaluate("[...document.images].map(i => i.naturalWidth)")
        assert len(widths) == 10 + 2 and min(widths) > 0
        shown.close()


def test_rates_are_counted_by_what_was_said():
    wrong = Finding(question="poses", verdict="wrong", sentence="", fixes=("camera-x180",))
    assert outcome([wrong], Case()) == "misled"
    assert outcome([wrong], Case(("camera-x180",))) == "right"
    unsure = replace(wrong, verdict="unclear", alternatives=(("camera-z180",),))
    assert outcome([unsure], Case(("camera-z180",))) == "among several"
    silent = replace(wrong, verdict="fits", fixes=())
    assert outcome([silent], Case(("camera-z180",))) == "silent"
    row = {"cell": "knot / window", "photographs": "COLMAP", "group": "camera", "visible": True}
    rows = [{**row, "outcome": said} for said in ("right", "right", "right", "misled")]
    rows.append({**row, "outcome": "silent", "visible": False})
    tables = conventions_tables(rows)
    assert "| camera | 75 / 0 / 0 / 25 | 4 |" in tables
    assert "| knot / window | 0 / 0 / 100 / 0 | 1 |" in tables


@pytest.mark.parametrize("case", CASES, ids=names)
def test_what_makes_a_mistake_is_undone_by_its_fixes(case):
    """As an import applies them: light and cameras from the right, the mesh from the left."""
    for kind in ("camera", "mesh", "light"):
        result = np.eye(3)
        for fix in fixes_named((*case.mistakes, *case.fixes)):
            if fix.kind == kind and fix.matrix is not None:
                result = fix.matrix @ result if kind == "mesh" else result @ fix.matrix
        np.testing.assert_array_equal(result, np.eye(3))
    count = [(*case.mistakes, *case.fixes).count(name) for name in (INVERSE, "texture-flip-v")]
    assert all(number in (0, 2) for number in count)


@pytest.mark.filterwarnings("ignore::svu_mi.SvuWarning")
def test_an_import_from_colmap_is_mended_by_what_the_check_says(knot, tmp_path):
    wrong = Case(("camera-x180",)).made(knot)  # as the tool has it
    written, folder = write(wrong, "colmap", tmp_path), tmp_path / "capture"
    source = read_source(written.path)
    import_capture(source, folder, written.options)
    found = svu.load_capture(folder)
    np.testing.assert_allclose(poses_of(found), poses_of(wrong), atol=1e-5)
    assert not np.allclose(poses_of(found), poses_of(knot), atol=0.1)
    findings, _ = find_mistakes(found)
    said = [name for one in findings if one.verdict == "wrong" for name in one.fixes]
    assert said == ["camera-x180"]
    import_capture(source, folder, replace(written.options, fixes=said))
    again = svu.load_capture(folder)
    np.testing.assert_allclose(poses_of(again), poses_of(knot), atol=1e-5)


def poses_of(capture):
    return np.array([to_world(sensor) for sensor in capture.sensors])
