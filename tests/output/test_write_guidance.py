"""What guidance writes, read back: poses, maps, pictures, and the record."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import mitsuba as mi
import numpy as np
import pytest
from matplotlib.figure import Figure
from support.helpers import write_older

import svu_mi as svu
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.source import frame_of
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import describe, make_sensor
from svu_mi.core.io.exr import read_exr, read_header
from svu_mi.guidance.strategies import TABLE
from svu_mi.output import direction_map as sky
from svu_mi.output import guidance_page
from svu_mi.output.object_views import viewing_frame
from svu_mi.output.run_record import RunInfo
from svu_mi.output.write_guidance import file_names, write_guidance, write_sensors

RNG_SEED = 1630517742
FILES = [
    "gain_0.exr", "gain_1.exr", "gain_2.exr", "guidance.json", "guidance.png", "run.json",
    "sensors.xml", "thumbnails", "transforms.json",
]  # fmt: skip
POSE = 1e-5  # a matrix goes through single precision once
RAY = 2e-6  # directions in single precision, over a focal length that was divided and multiplied


@pytest.fixture(scope="module")
def guidance(vase):
    """Guidance that looks at all texels; three of 14 candidates cannot be reached."""
    candidates = svu.Candidates.around(vase.capture, 14).restricted(np.arange(14) % 5 != 2)
    return svu.next_best_view(vase.estimate, candidates, 3, texels=vase.texels.count)


@pytest.fixture(scope="module")
def written(vase, guidance, tmp_path_factory):
    """The folder of that guidance, in which an older run has left its files."""
    folder = tmp_path_factory.mktemp("written")
    write_older(folder, "guide", "run.json", ["gain_7.exr", "thumbnails/proposal_7.png"])
    run = RunInfo(settings={"add": 3}, kernels={"a": 1})
    write_guidance(vase.capture, vase.estimate, guidance, folder, run)
    return folder


def rays(sensor):
    """Origins and directions (N, 6) through points all over a film."""
    points = np.random.default_rng(RNG_SEED).random((16, 2)).astype(np.float32)
    place = mi.Point2f(points[:, 0], points[:, 1])
    ray, _ = sensor.sample_ray(0, 0.5, place, mi.Point2f(0.5))
    directions = np.array(ray.d).T
    return np.hstack([np.broadcast_to(to_world(sensor)[:3, 3], directions.shape), directions])


def test_all_files_are_new_and_an_older_run_is_replaced(written):
    names = sorted(path.name for path in written.iterdir())
    assert names == sorted(FILES)
    assert sorted(p.name for p in (written / "thumbnails").iterdir()) == [
        "proposal_0.png", "proposal_1.png", "proposal_2.png",
    ]  # fmt: skip
    for name in ("transforms.json", "sensors.xml"):  # to go on from
        assert svu.Candidates.read(written / name).count == 3


def test_the_plan_says_where_to_go(guidance, written):
    plan = json.loads((written / "guidance.json").read_text())
    assert plan["settings"]["options"]["strategy"] == "entropy"
    assert plan["settings"]["preset"] == "default" and plan["photographs"] == 4
    assert plan["entropy"] == guidance.entropy
    assert [p["rank"] for p in plan["proposals"]] == [1, 2, 3]
    assert [p["file"] for p in plan["proposals"]] == [f"view_{k:04d}.exr" for k in (4, 5, 6)]
    for entry, proposal in zip(plan["proposals"], guidance.proposals, strict=True):
        for key in ("candidate", "name", "gain", "error", "entropy", "sees", "new"):
            assert entry[key] == getattr(proposal, key)
        made = make_sensor(entry["pose"], "proposal")
        np.testing.assert_allclose(to_world(made), to_world(proposal.sensor), atol=POSE)
        np.testing.assert_allclose(rays(made), rays(proposal.sensor), atol=RAY)


def test_the_plan_ranks_all_candidates(guidance, written):
    ranked = json.loads((written / "guidance.json").read_text())["candidates"]
    assert sorted(c["number"] for c in ranked) == list(range(14))
    assert [c["number"] for c in ranked if not c["reachable"]] == [2, 7, 12]
    assert all((c["gain"] is None) != c["reachable"] for c in ranked)
    gains = [c["gain"] for c in ranked if c["reachable"]]
    assert gains == sorted(gains, reverse=True) and not any(c["reachable"] for c in ranked[11:])
    assert ranked[0]["number"] == guidance.proposals[0].candidate


def test_maps_sum_to_the_gain(vase, guidance, written):
    """All texels were looked at, so the mean of the map is the gain, up to single precision."""
    inside = vase.texels.inside()
    for k, proposal in enumerate(guidance.proposals):
        image = read_exr(written / f"gain_{k}.exr")["Y"]
        assert image.shape == (48, 64) and proposal.error == 0
        assert float(image[inside].mean(dtype=np.float64)) == pytest.approx(proposal.gain, abs=1e-6)
        header = read_header(written / f"gain_{k}.exr").attributes
        assert header["svu:candidate"] == proposal.candidate


FILMS = {
    "upright": {"film": [30, 52], "crop_size": [30, 52]},
    "shifted": {"principal_point_offset": [0.1, -0.07]},
    "cropped": {"crop_offset": [11, 5], "crop_size": [30, 20]},
    "all": {"film": [52, 60], "crop_offset": [3, 9], "crop_size": [41, 20],
            "principal_point_offset": [-0.2, 0.15]},
}  # fmt: skip


@pytest.mark.parametrize("film", FILMS)
@pytest.mark.parametrize("kind", ["transforms.json", "sensors.xml"])
def test_any_film_comes_back(vase, tmp_path, film, kind):
    sensor = make_sensor({**describe(vase.capture.sensors[1]), **FILMS[film]}, "any")
    if kind == "sensors.xml":
        write_sensors(tmp_path / kind, [sensor], ["view_0007"])
    else:
        write_transforms(tmp_path / kind, [frame_of(sensor, Path("view_0007.exr"))])
    (loaded,) = svu.Candidates.read(tmp_path / kind).sensors
    np.testing.assert_allclose(to_world(loaded), to_world(sensor), atol=POSE)
    np.testing.assert_allclose(rays(loaded), rays(sensor), atol=RAY)
    assert describe(loaded)["crop_size"] == describe(sensor)["crop_size"]


def test_sensors_can_be_included_in_a_scene(written, tmp_path):
    (tmp_path / "scene.xml").write_text(
        f'<scene version="3.0.0"><include filename="{written / "sensors.xml"}"/>'
        '<shape type="sphere"/><emitter type="constant"/></scene>'
    )
    scene = mi.load_file(str(tmp_path / "scene.xml"), spp=3)
    assert [sensor.id() for sensor in scene.sensors()] == ["view_0004", "view_0005", "view_0006"]
    assert scene.sensors()[0].sampler().sample_count() == 3


def test_pictures_show_what_the_camera_will(written):
    assert list(mi.Bitmap(str(written / "guidance.png")).size()) == [1800, 1120]
    picture = np.array(mi.Bitmap(str(written / "thumbnails" / "proposal_0.png"))) / 255
    assert picture.shape == (384, 512, 3)  # all of the film, enlarged
    colour = np.ptp(picture, axis=2)
    assert (colour > 0.3).any() and (colour[picture.min(axis=2) < 0.9] < 0.05).mean() > 0.2


def test_a_sensor_of_the_capture_keeps_its_file_name(vase, guidance):
    used = (True, False, True, False)
    capture = replace(vase.capture, used=used)
    candidates = svu.Candidates.without_photograph(capture)
    other = guidance.proposals[0]
    proposals = [other, *(replace(other, sensor=sensor) for sensor in candidates.sensors), other]
    names = file_names(capture, SimpleNamespace(proposals=proposals))
    assert names == ["view_0004.exr", "view_0001.exr", "view_0003.exr", "view_0005.exr"]


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 2), (0.3, -1, 0.2)])
def test_directions_are_seen_from_outside(up):
    """Up is above, the first photograph in front, and right is where it is from outside."""
    up, first = np.array(up, float), np.array([0.4, 0.3, 0.8])
    frame = viewing_frame(up, first)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(frame @ up / np.linalg.norm(up), [0, 1, 0], atol=1e-12)
    assert frame[2] @ first > 0 and abs(frame[0] @ first) < 1e-12
    assert np.linalg.det(frame) == pytest.approx(1)  # not mirrored


def test_the_map_of_directions_is_hammers():
    """Of equally many directions per area, equally many lie in both halves of the ellipse."""
    x, y = sky._hammer(np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0], [-1e-9, 0, -1.0]]))
    right = 2 * np.sin(np.pi / 4) * np.sqrt(2 / (1 + 2**-0.5))
    np.testing.assert_allclose(x, [0, 0, right, -2 * np.sqrt(2)], atol=1e-6)
    np.testing.assert_allclose(y, [np.sqrt(2), 0, 0, 0], atol=1e-6)
    directions = np.random.default_rng(RNG_SEED).normal(size=(20_000, 3))
    x, y = sky._hammer(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    radius = (x / 8**0.5) ** 2 + (y / 2**0.5) ** 2
    assert radius.max() <= 1 + 1e-9
    assert (radius < 0.5).mean() == pytest.approx(0.5, abs=0.015)  # four standard errors


@pytest.mark.parametrize("strategy", [name for name in TABLE if name != "entropy"])
def test_the_page_is_drawn_for_every_strategy(vase, guidance, tmp_path, strategy):
    options = {"strategy": strategy, "texels": 200}
    guidance = svu.next_best_view(vase.estimate, guidance.candidates, 1, **options)
    figure = Figure()
    axes = figure.subplots(1, 3)
    sky.draw_directions(axes[0], vase.capture, guidance, up=(0, 0, 1))
    guidance_page.draw_expected(axes[1], vase.capture, guidance)
    guidance_page.draw_ranking(axes[2], guidance)
    figure.savefig(tmp_path / "page.png")
    assert matplotlib.image.imread(tmp_path / "page.png").ndim == 3
    assert TABLE[strategy].unit


@pytest.mark.slow
def test_a_single_candidate_that_gains_nothing_is_drawn(vase, tmp_path):
    """Under the vase's centre, looking away: no texel is seen, and no gain has a colour."""
    away = describe(vase.capture.sensors[0])
    away["to_world"] = np.array(away["to_world"]) @ np.diag([-1.0, 1, -1, 1])
    candidates = svu.Candidates.of([make_sensor(away, "away")])
    guidance = svu.next_best_view(vase.estimate, candidates)
    assert guidance.proposals[0].gain == 0
    write_guidance(vase.capture, vase.estimate, guidance, tmp_path)
    assert read_exr(tmp_path / "gain_0.exr")["Y"].max() == 0
