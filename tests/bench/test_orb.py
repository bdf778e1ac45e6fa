"""Stanford-ORB: its layout read and written, its rules, and its benchmark on a rendered set."""

from __future__ import annotations

import csv
import json
import shutil
import sys
import types
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from svu_mi import scenes
from svu_mi.bench import orb
from svu_mi.bench.cases import own_cases
from svu_mi.bench.experiment import BenchRun
from svu_mi.bench.orb import (
    ROWS,
    STUDY,
    OrbCase,
    OrbSizes,
    chosen_captures,
    chosen_rows,
    dataset,
    orb_metrics,
)
from svu_mi.bench.orb.dataset import DatasetSizes, find_captures, render_dataset
from svu_mi.bench.orb.orb_metrics import orb_albedo_error, orb_error
from svu_mi.bench.orb.orb_results import OrbCapture, OrbPhotograph, write_orb
from svu_mi.bench.orb.orb_tables import GREY, orb_lines
from svu_mi.bench.orb.orb_targets import Target, score_pictures
from svu_mi.bench.problem_sizes import RecoverySizes
from svu_mi.bench.study import Selection, run_bench
from svu_mi.capture.image_io import read_planes
from svu_mi.capture.importers.axis_fixes import rotation
from svu_mi.capture.importers.envmap import read_environment_map
from svu_mi.capture.importers.registry import read_source
from svu_mi.capture.importers.stanford_orb import read_orb, read_views, recognises
from svu_mi.capture.mesh import MeshArrays, arrays
from svu_mi.errors import CaptureError, MeshError, OptionError, ShapeError, SvuWarning
from svu_mi.recovery.svbrdf_textures import Textures

LIGHTS = ("window", "studio")
PHOTOGRAPHS = DatasetSizes(train=12, test=2, film=48, spp=48, test_spp=1024, environment=128)
TINY = OrbSizes(film=48, texels=48, spp=256, recovery=RecoverySizes(warm=False, repeats=1))
FIRST, SECOND = "vase_scene001", "vase_scene002"


# --- the layout ---------------------------------------------------------------------------


def pose(rng):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


def photograph(rng, size=(6, 8)):
    return OrbPhotograph(
        image=rng.uniform(size=(*size, 3)).astype(np.float32),
        mask=np.ones(size),
        to_world=pose(rng),
        environment=rng.uniform(size=(4, 8, 3)),
        albedo=np.full((*size, 3), 0.5),
    )


@pytest.fixture
def written(tmp_path):
    """Two captures of a triangle, without any rendering."""
    rng = np.random.default_rng(605120984)
    mesh = MeshArrays(
        positions=rng.normal(size=(3, 3)), faces=np.array([[0, 1, 2]]),
        normals=np.array([[0.0, 0.6, 0.8]] * 3), uvs=rng.uniform(size=(3, 2)),
    )  # fmt: skip
    captures = [
        OrbCapture(
            name=f"cup_scene{k:03d}", x_fov=30.0 + k, world=pose(rng),
            train=[photograph(rng) for _ in range(3)], test=[photograph(rng) for _ in range(2)],
        )
        for k in (1, 2)
    ]  # fmt: skip
    write_orb(tmp_path, mesh, captures)
    return tmp_path, mesh, captures


def test_a_written_data_set_is_read(written):
    root, mesh, (capture, _) = written
    path = root / "blender_HDR" / capture.name
    source = read_orb(path)
    assert recognises(path, "train") and source.root == root and len(source.notes) == 2
    assert source.mesh == root / "ground_truth" / capture.name / "mesh_blender/mesh.obj"
    focal = 4 / np.tan(np.radians(31 / 2))
    for frame, shot in zip(source.frames, capture.train, strict=True):
        np.testing.assert_allclose(frame.to_world, shot.to_world, atol=1e-12)
        assert frame.focal == pytest.approx((focal, focal)) and frame.size == (8, 6)
        assert frame.center == (4, 3)
        color = np.stack(read_planes(frame.image)[0], axis=-1)
        np.testing.assert_array_equal(color, shot.image)
        assert read_planes(frame.mask)[0][0].min() == 1
    lines = [line.split() for line in source.mesh.read_text().splitlines()]
    rows = {key: np.array([w[1:] for w in lines if w[0] == key], float) for key in ("v", "vn")}
    turn, shift = capture.world[:3, :3], capture.world[:3, 3]
    np.testing.assert_allclose(rows["v"], mesh.positions @ turn.T + shift, atol=1e-7)
    x, y, z = (mesh.normals @ turn.T).T
    np.testing.assert_allclose(rows["vn"], np.stack([x, -z, y], axis=-1), atol=1e-7)


def test_eight_bit_photographs_match_floats(written):
    root, _, (capture, _) = written
    high, low = (read_orb(root / kind / capture.name) for kind in ("blender_HDR", "blender_LDR"))
    for a, b in zip(high.frames, low.frames, strict=True):
        np.testing.assert_array_equal(a.to_world, b.to_world)
        assert b.image.suffix == ".png" and b.transfer == "srgb" and read_planes(b.image)[1]
    assert low.light.path == high.light.path and low.mesh == high.mesh


def test_the_light_turns_with_the_camera_of_its_photograph(written):
    root, _, (capture, _) = written
    path = root / "blender_HDR" / capture.name
    chosen = read_orb(path).light, read_orb(path, environment_view="0004").light
    for light, shot in zip(chosen, capture.test, strict=True):
        np.testing.assert_allclose(light.to_world, shot.to_world[:3, :3], atol=1e-12)
        pixels, _, _ = read_environment_map(light)
        np.testing.assert_allclose(pixels[1::2], shot.environment, rtol=1e-6)  # others: between
    assert "2 environment maps, one per test photograph; the map of 0003" in read_orb(path).notes[0]
    with pytest.raises(OptionError, match="'0000'; use one of 0003, 0004"):
        read_orb(path, environment_view="0000")


def test_a_single_environment_map_is_no_choice(written):
    root, _, (capture, _) = written
    (root / "ground_truth" / capture.name / "env_map" / "0004.exr").unlink()
    assert not any("one per test" in n for n in read_orb(root / "blender_HDR" / capture.name).notes)


def test_photographs_of_other_places_have_a_pose_here(written):
    root, _, (here, there) = written
    path = root / "blender_HDR" / here.name
    source = read_orb(path, split=there.name)
    for frame, shot in zip(source.frames, there.test, strict=True):
        on_object = np.linalg.inv(there.world) @ shot.to_world
        np.testing.assert_allclose(
            np.linalg.inv(here.world) @ frame.to_world, on_object, atol=1e-12
        )
        assert frame.image.parent == root / "blender_HDR" / there.name / "test"
        assert frame.focal[0] == pytest.approx(4 / np.tan(np.radians(32 / 2)))
    assert source.light.path.parent.parent.name == there.name
    with pytest.raises(OptionError, match="no photographs of 'cup_scene007'"):
        read_orb(path, split="cup_scene007")


def test_svu_import_recognises_it(written):
    root, _, (capture, _) = written
    assert read_source(root / "blender_HDR" / capture.name).format == "stanford-orb"
    assert [path.name for path in find_captures(root)] == ["cup_scene001", "cup_scene002"]
    with pytest.raises(OptionError, match="no capture found"):
        find_captures(root / "blender_HDR")
    with pytest.raises(CaptureError, match="not a capture of Stanford-ORB"):
        read_views(root, "train")


def test_ground_truth_is_required_for_mesh_and_light(written):
    root, _, (capture, _) = written
    shutil.rmtree(root / "ground_truth")
    source = read_orb(root / "blender_HDR" / capture.name)
    assert source.mesh is None and source.light is None and "--environment" in source.notes[0]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"file_path": "../../secret"}, "lies outside"),
        ({"file_path": "/etc/passwd"}, "lies outside"),
        ({"file_path": 7}, "file_path must be text"),
        ({"file_path": "train/9999"}, "9999.exr: no such photograph"),
        ({"scene_name": "../ground_truth"}, "lies outside"),
        ({"scene_name": "cup_scene002/test"}, "must be the name of a capture"),
        ({"scene_name": ["cup"]}, "must be text"),
        ({"transform_matrix": [[1, 2], [3, 4]]}, "a frame needs transform_matrix"),
        ({"transform_matrix": np.diag([-1.0, 1, 1, 1]).tolist()}, "mirrored"),
        ({"camera_angle_x": "wide"}, "a frame needs"),
        ({"camera_angle_x": 0}, "camera_angle_x must be a number in"),
        (None, r"frames\[1\] must be an object"),
    ],
)
def test_a_broken_frame_is_named(written, changes, sentence):
    root, _, (capture, _) = written
    file = root / "blender_HDR" / capture.name / "transforms_train.json"
    record = json.loads(file.read_text())
    record["frames"][1] = None if changes is None else {**record["frames"][1], **changes}
    file.write_text(json.dumps(record))
    with pytest.raises(CaptureError, match=sentence) as error:
        read_orb(file.parent)
    assert any(name in str(error.value) for name in ("frame 1", "frames[1]", "9999"))


def test_a_mesh_is_written_with_normals_and_uvs(written, tmp_path):
    _, mesh, captures = written
    with pytest.raises(MeshError, match="normals and UVs"):
        write_orb(tmp_path / "other", replace(mesh, uvs=None), captures)


# --- the rules ----------------------------------------------------------------------------


def pictures():
    """Return a photograph, a rendered picture, and a mask that reaches one border."""
    rng = np.random.default_rng(330917452)
    truth = rng.uniform(size=(14, 17, 3)) * 3
    picture = truth * [0.5, 1, 2] + rng.uniform(size=truth.shape) * 0.2
    mask = np.zeros((14, 17), bool)
    mask[3:, 2:15] = True
    inside = np.zeros_like(mask)
    inside[5:, 4:13] = True  # two pixels less, but not at the border
    return picture, truth, mask, inside


def encode(x):
    return np.where(x > 0.0031308, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055, 12.92 * x)


def decibels(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))


def test_psnr_scales_channels_on_the_eroded_mask():
    picture, truth, mask, inside = pictures()
    for scaled in (True, False):
        a, b = (np.where(inside[..., None], x, 0) for x in (picture, truth))
        if scaled:
            for c in range(3):
                a[..., c] *= (a[..., c] * b[..., c]).sum() / (a[..., c] ** 2).sum()
        gain = encode(np.clip(b, 0, 1)).mean() / np.clip(b, 0, 1).mean()
        error = orb_error(picture, truth, mask, scaled=scaled)
        high = decibels(np.clip(gain * a, 0, 4), np.clip(gain * b, 0, 4))
        low = decibels(encode(np.clip(a, 0, 1)), encode(np.clip(b, 0, 1)))
        assert (error.psnr_hdr, error.psnr_ldr) == pytest.approx((high, low), abs=1e-9)
    error = orb_albedo_error(picture / 3, truth / 3, mask)
    a, b = (np.where(inside[..., None], x / 3, 0) for x in (picture, truth))
    a *= (a * b).sum(axis=(0, 1)) / (a**2).sum(axis=(0, 1))
    assert error.psnr_ldr == pytest.approx(decibels(np.clip(a, 0, 1), b), abs=1e-9)
    assert error.psnr_hdr is None


def test_psnr_is_at_least_that_of_grey():
    picture, truth, mask, inside = pictures()
    truth = truth / 30
    bad = orb_error(np.full_like(picture, 1e3), truth, mask, scaled=False)
    grey = np.where(inside[..., None], 0.5, 0) * np.ones(3)
    low = np.where(inside[..., None], encode(truth), 0)
    assert bad.psnr_ldr == pytest.approx(decibels(grey, low), abs=1e-9)


def test_invalid_pictures_are_refused():
    picture, truth, mask, _ = pictures()
    with pytest.raises(ShapeError, match="Two .H, W, 3. pictures"):
        orb_error(picture[:5], truth, mask, scaled=True)
    with pytest.raises(ShapeError, match="mask is empty"):
        orb_error(picture, truth, np.zeros_like(mask), scaled=True)
    truth[7, 7] = np.nan
    with pytest.raises(OptionError, match="the true picture has 3 values"):
        orb_error(picture, truth, mask, scaled=True)
    truth[7, 7], truth[0, 0] = 1, np.nan  # outside of the mask
    black = orb_error(picture * [1, 0, 1], truth, mask, scaled=True)
    assert np.isfinite([black.psnr_hdr, black.ssim]).all()


def test_lpips_is_computed_if_installed(monkeypatch):
    """Stand-ins for ``torch`` and the network: mean squared difference."""

    def distance(a, b, normalize):
        assert normalize
        return np.mean((a - b) ** 2)

    picture, truth, mask, inside = pictures()
    torch = types.ModuleType("torch")
    torch.no_grad, torch.from_numpy = pytest.MonkeyPatch.context, np.array
    monkeypatch.setitem(sys.modules, "torch", torch)
    monkeypatch.setattr(orb_metrics, "_network", lambda: distance)
    error = orb_error(picture, truth, mask, scaled=False)
    a, b = (np.where(inside[..., None], np.clip(x, 0, 1), 0) for x in (picture, truth))
    twice = np.mean((encode(encode(a)) - encode(encode(b))) ** 2)
    assert error.lpips == pytest.approx(twice, rel=1e-4)
    monkeypatch.setattr(orb_metrics, "_network", lambda: None)
    assert orb_error(picture, truth, mask, scaled=False).lpips is None


# --- the benchmark ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("orb")
    render_dataset(root, own_cases(["vase"], LIGHTS), PHOTOGRAPHS)
    return root


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("orb_bench")


def bench_in(folder, **changes):
    return BenchRun(folder, quick=True, **changes)


@pytest.fixture(scope="module", autouse=True)
def _tiny():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(orb, "QUICK", TINY)
        yield


@pytest.fixture(scope="module")
def setting(data, folder):
    rows = chosen_rows(["SH (ours)"])
    return OrbCase(bench_in(folder), data / "blender_HDR" / FIRST, rows, None, False)


def run(folder, data, captures=(FIRST,), **changes):
    selection = Selection(data=data, objects=captures, rows=["SH (ours)"])
    return run_bench(bench_in(folder, **changes), ["orb"], selection)["orb"]


@pytest.fixture(scope="module")
def record(data, folder):
    return run(folder, data)


def true_textures():
    place = scenes.path("vase").parent
    channels = {"base_color": 3, "roughness": 1, "metallic": 1}
    return Textures(**{
        name: mi.TensorXf(np.stack(read_planes(place / f"{name}.exr")[0][:count], axis=-1))
        for name, count in channels.items()
    })  # fmt: skip


@pytest.mark.slow
def test_normals_of_the_scan_are_computed_anew(setting):
    mesh = arrays(setting.capture.mesh)
    corners = mesh.positions[mesh.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-12)
    assert np.einsum("fi,fi->f", face, mesh.normals[mesh.faces].mean(axis=1)).mean() > 0.9


@pytest.mark.slow
def test_true_textures_under_their_light_match_photographs(setting):
    textures = true_textures()
    scores = setting.score(textures, "truth")
    assert scores["light"]["mean"]["psnr_ldr"] > 40 and scores["light"]["mean"]["psnr_hdr"] > 30
    assert scores["view"]["mean"]["psnr_ldr"] > 40 and scores["view"]["mean"]["psnr_hdr"] > 30
    assert scores["albedo"]["mean"]["psnr_ldr"] > 45
    turned_light = [
        replace(target, view=replace(target.view, light=replace(
            target.view.light, to_world=target.view.light.to_world @ rotation("y", 180)
        )))
        for target in setting.novel
    ]  # fmt: skip
    wrong = [target.picture(setting.capture, textures, 32) for target in turned_light]
    assert score_pictures(setting.novel, wrong, scaled=True)["mean"]["psnr_ldr"] < 27


@pytest.mark.slow
def test_recovered_textures_are_far_better_than_grey(record):
    (capture,) = record["cells"]
    grey, recovered = capture["grey"], capture["rows"]["SH (ours)"]
    assert capture["name"] == FIRST and capture["photographs"] == PHOTOGRAPHS.train
    assert 0 < capture["entropy"] < 1 and 0.4 < capture["seen"] / capture["texels"] < 1  # hollow
    for task, gain in (("light", 3), ("view", 5), ("albedo", 3)):
        assert recovered[task]["mean"]["psnr_ldr"] > grey[task]["mean"]["psnr_ldr"] + gain
        assert recovered[task]["mean"]["ssim"] > grey[task]["mean"]["ssim"]
    assert {one["capture"] for one in recovered["light"]["single"]} == {SECOND}
    assert {one["capture"] for one in recovered["view"]["single"]} == {FIRST}


@pytest.mark.slow
def test_record_csv_and_pictures_are_written(record, folder):
    stored = json.loads((folder / "orb.json").read_text())
    assert stored["cells"][0]["name"] == FIRST
    with (folder / "orb.csv").open(encoding="utf-8") as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 2 * 3 * PHOTOGRAPHS.test  # grey and SH, three tasks
    assert {line["row"] for line in lines} == {GREY, "SH (ours)"}
    text = (folder / "bench.md").read_text()
    assert "26.918" in text and "| SH (ours) |" in text
    grey, recovered = orb_lines(record)
    assert grey.startswith(f"{GREY}: PSNR-H ") and recovered.startswith("SH (ours): PSNR-H ")
    assert recovered.endswith("LPIPS -")
    assert (folder / "orb" / FIRST / "sh_ours.png").stat().st_size > 5000


@pytest.mark.slow
def test_finished_results_are_kept(record, data, folder):
    assert run(folder, data, stored=True)["cells"] == record["cells"]


@pytest.mark.slow
def test_an_unreadable_capture_is_skipped(record, data, folder, monkeypatch):
    head = OrbCase.head

    def torn(self):
        if self.name == SECOND:
            raise CaptureError("torn")
        return head(self)

    monkeypatch.setattr(OrbCase, "head", torn)
    with pytest.warns(SvuWarning, match="vase_scene002 is skipped: torn"):
        record = run(folder, data, ())
    assert [capture["name"] for capture in record["cells"]] == [FIRST]
    assert record["failed"] == [{"cell": SECOND, "reason": "torn"}]


@pytest.mark.slow
def test_a_test_photograph_needs_light_and_mask(data):
    view = read_views(data / "blender_HDR" / FIRST, "test")[0]
    with pytest.raises(CaptureError, match="0012.exr: the environment map is missing"):
        Target.of(replace(view, light=None), 48)
    with pytest.raises(CaptureError, match="the mask is missing"):
        Target.of(replace(view, frame=replace(view.frame, mask=None)), 48)
    wide = data / "ground_truth" / FIRST / "env_map" / "0012.exr"
    with pytest.raises(CaptureError, match="mask and photograph differ in size"):
        Target.of(replace(view, frame=replace(view.frame, mask=wide)), 48)
    small = Target.of(view, 24)
    assert small.photograph.shape == (24, 24, 3) and small.mask.any()
    whole = Target.of(view, 48).photograph.reshape(24, 2, 24, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small.photograph, whole, rtol=1e-5)


@pytest.mark.slow
def test_names_are_checked_before_a_run(data):
    folders = find_captures(data)
    assert chosen_captures(folders, ["vase"]) == chosen_captures(folders, []) == folders
    assert [path.name for path in chosen_captures(folders, [SECOND])] == [SECOND]
    with pytest.raises(OptionError, match="Unknown capture or object 'cup'"):
        chosen_captures(folders, ["cup"])
    with pytest.raises(OptionError, match="Unknown row 'best'"):
        chosen_rows(["best"])
    labels = [row.label for row in chosen_rows([])]
    assert labels == ["SH (ours)", "SH (paper)", "spectrum (paper)"]
    assert all(row.options()[1].max_depth is None for row in ROWS)


@pytest.mark.slow
def test_own_scenes_replace_the_data_set(tmp_path, monkeypatch):
    rendered = []

    def note(root, cases, sizes, progress):
        rendered.append([case.name for case in cases])

    monkeypatch.setattr(dataset, "render_dataset", note)
    for _ in range(2):
        folder = dataset.own_dataset(bench_in(tmp_path))
    assert folder == tmp_path / "orb" / "data" and len(rendered) == 1
    assert rendered[0][:2] == ["vase__window", "vase__overcast"]
    with pytest.raises(OptionError, match="no capture found"):
        STUDY.run(bench_in(tmp_path), Selection())
