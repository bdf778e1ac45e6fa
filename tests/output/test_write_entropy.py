"""Files of a run: maps, overview and run.json; what a failure leaves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import mitsuba as mi
import numpy as np
import pytest
from matplotlib import pyplot
from support.unseen import blind

import svu_mi as svu
from svu_mi.capture.tonemap import ObjectView, object_only_scene, tone_mapped
from svu_mi.core.io.exr import read_exr, read_header
from svu_mi.errors import OutputError
from svu_mi.output import object_views
from svu_mi.output.interval_summary import IntervalSummary
from svu_mi.output.maps import write_maps
from svu_mi.output.overview import _hatch, write_overview
from svu_mi.output.run_record import RunInfo, write_manifest
from svu_mi.output.style import new_figure
from svu_mi.output.write_entropy import write_outputs


def with_entropy(estimate, value):
    """The estimate, had its entropy been this everywhere."""
    entropy = np.full(estimate.texels.count, value, np.float32)
    return SimpleNamespace(**vars(estimate) | {"entropy": entropy})


def written(folder):
    return [read_exr(folder / f"{name}.exr")["Y"] for name in ("entropy", "coverage")]


# --- Maps ---------------------------------------------------------------------------------


def test_maps_are_laid_out_row_by_row_from_v_0(tmp_path, vase):
    write_maps(vase.estimate, tmp_path)
    entropy, coverage = written(tmp_path)
    assert entropy.shape == (48, 64)
    u, v = np.array(vase.texels.uv)
    row, column = (v * 48).astype(int), (u * 64).astype(int)
    np.testing.assert_array_equal(entropy[row, column], np.array(vase.estimate.entropy))
    np.testing.assert_array_equal(coverage[row, column], np.array(vase.estimate.coverage))
    assert read_header(tmp_path / "entropy.exr").attributes["svu:preset"] == "default"


@pytest.mark.parametrize("gutter", [0, 3])
def test_only_the_outside_is_a_gutter(tmp_path, vase, gutter):
    """Distances of all texels outside to the charts are found by brute force."""
    write_maps(with_entropy(vase.estimate, 0.5), tmp_path, gutter=gutter)
    entropy, coverage = written(tmp_path)
    inside = vase.texels.inside()
    assert (entropy[inside] == 0.5).all() and (coverage[inside] == 0).any()
    centers, outside = np.argwhere(inside), np.argwhere(~inside)
    distance = np.linalg.norm(outside[:, None] - centers, axis=-1).min(axis=1)
    expected = np.where(distance <= gutter, np.float32(0.5), 1)
    np.testing.assert_array_equal(entropy[~inside], expected)
    assert (coverage[~inside][distance > gutter] == 0).all()


# --- Overview -----------------------------------------------------------------------------


def pixels(path: Path) -> np.ndarray:
    return np.array(mi.Bitmap(str(path)))[..., :3]


@pytest.mark.slow
def test_the_overview_is_a_page_of_1600_pixels(tmp_path, vase):
    """No window, no figure of pyplot's that stays in memory, no setting changed."""
    before = dict(matplotlib.rcParams), pyplot.get_fignums()
    write_overview(vase.capture, vase.estimate, tmp_path / "overview.png")
    assert (dict(matplotlib.rcParams), pyplot.get_fignums()) == before
    page = pixels(tmp_path / "overview.png")
    assert page.shape == (1020, 1600, 3)
    # Both ends of viridis and the grey of unseen texels are on it.
    for color in ((253, 231, 36), (68, 1, 84), (140, 140, 147)):
        assert (np.abs(page.astype(int) - color).max(axis=2) <= 2).any(), color


@pytest.mark.parametrize("used", [(False,) * 4, (True, False, False, False)])
def test_the_overview_works_with_few_views_and_nothing_seen(tmp_path, vase, used):
    few = replace(vase.capture, used=used)
    write_overview(few, blind(vase.estimate), tmp_path / "overview.png")
    assert pixels(tmp_path / "overview.png").std() > 0


def test_one_column_of_texels_can_be_drawn():
    """Which has no contour."""
    inside = np.array([[True], [False], [True]])
    axes = new_figure(2, 2).add_subplot()
    texels = SimpleNamespace(inside=lambda: inside)
    _hatch(axes, SimpleNamespace(texels=texels, coverage=np.array([0, 1])))
    assert axes.get_legend() is not None


def test_the_views_shown_are_far_apart(vase):
    """First the one that sees most, then the used one in the most different direction."""
    capture = replace(vase.capture, used=(True, True, True, False))
    first, second = object_views.distant_views(capture, [5, 9, 3])
    matrices = [np.array(s.world_transform().matrix).reshape(4, 4) for s in capture.sensors]
    forward = np.array([m[:3, 2] for m in matrices])
    assert first == 1
    assert second == min((0, 2), key=lambda i: forward[i] @ forward[1])
    assert sorted(object_views.distant_views(vase.capture, None, 9)) == [0, 1, 2, 3]


def test_a_picture_shows_the_object_where_the_photograph_does(vase):
    color = np.broadcast_to(np.float32([0.2, 0.4, 0.8]), (8, 8, 3))
    shown = ObjectView.at(object_only_scene(vase.capture), vase.capture.sensors[1]).painted(color)
    assert shown.shape == (36, 48, 4)
    covered, empty = shown[..., 3] == 1, shown[..., 3] == 0
    assert covered.any() and empty.any()
    # At the edge, the 9 mask rays of a pixel and its 16 colour rays may disagree.
    assert (np.abs(shown[empty][:, :3] - 1) < 1e-6).mean() > 0.98
    hue = shown[covered][:, 2] / shown[covered][:, 0]  # shading keeps it
    assert (np.abs(hue - 4) < 1e-3).mean() > 0.98
    left, right, top, bottom = object_views.object_window(shown[..., 3] > 0)
    rows, columns = np.nonzero(shown[..., 3])
    assert left * 48 <= columns.min() and columns.max() < right * 48
    assert top * 36 <= rows.min() and rows.max() < bottom * 36


def test_the_window_is_centred_on_the_object():
    alpha = np.zeros((10, 20))
    alpha[3:7, 4:8] = 1
    left, right, top, bottom = object_views.object_window(alpha)
    assert left + right == pytest.approx(2 * 6 / 20) and top + bottom == pytest.approx(2 * 5 / 10)


def test_tone_mapping_exposes_for_the_object():
    photograph = np.full((10, 10, 3), 100.0, np.float32)
    photograph[2:5, 2:5] = 4.0
    photograph[0, 0] = np.nan
    mask = photograph[..., 0] == 4
    mapped = tone_mapped(photograph, mask)
    np.testing.assert_allclose(mapped[3, 3], 1, atol=1e-6)
    np.testing.assert_allclose(mapped[0, 0], 0.5)
    assert np.isfinite(mapped).all()
    # sRGB: 18 % grey is 0.461 of full scale.
    grey = tone_mapped(np.array([[[0.18] * 3] + [[1.0] * 3] * 9], np.float32))
    np.testing.assert_allclose(grey[0, 0], 0.461, atol=0.005)


# --- Manifest and the whole folder --------------------------------------------------------


def refuse(token: str):
    raise ValueError(f"{token} is not JSON")


def test_the_manifest_is_plain_json(tmp_path):
    record = {
        "preset": svu.preset("fast", method="spectrum"), "path": Path("a/b"), "array": np.eye(2),
        "count": np.int64(3), "lanes": mi.Float([1, 2]), "nan": float("nan"),
        "inf": np.float32(np.inf), "tuple": (1, None, True), "set": {"b", "a"}, 5: "five", "ä": "ö",
    }  # fmt: skip
    write_manifest(tmp_path / "run.json", record)
    text = (tmp_path / "run.json").read_text(encoding="utf-8")
    read = json.loads(text, parse_constant=refuse)
    assert read.pop("preset")["degree"] == 4
    assert read == {
        "path": "a/b", "array": [[1, 0], [0, 1]], "count": 3, "lanes": [1, 2], "nan": None,
        "inf": None, "tuple": [1, None, True], "set": ["a", "b"], "5": "five", "ä": "ö",
    }  # fmt: skip
    with pytest.raises(OutputError, match=r"no\.json\.outer\.inner\[1\]: a function"):
        write_manifest(tmp_path / "no.json", {"outer": {"inner": [1, refuse]}})
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


def test_a_run_leaves_four_files_and_nothing_else(tmp_path, vase):
    folder = tmp_path / "new" / "out"
    capture = replace(vase.capture, used=(True, True, True, False), warnings=("a sentence",))
    estimate = replace(
        vase.estimate, timings={"Fitting": 0.25, "Broken": float("nan")},
        seen_per_view=vase.estimate.seen_per_view[:3],
    )  # fmt: skip
    write_outputs(capture, estimate, folder, RunInfo(settings={"seed": 7}, kernels={"Fitting": 2}))
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["coverage.exr", "entropy.exr", "overview.png", "run.json"]
    record = json.loads((folder / "run.json").read_text(), parse_constant=refuse)
    assert record["settings"]["given"] == {"seed": 7}
    assert record["settings"]["preset"]["name"] == "default"
    assert record["settings"]["resolution"] == [64, 48]
    assert record["timings_s"] == {"Fitting": 0.25, "Broken": None}
    assert record["kernels_compiled"] == {"Fitting": 2}
    assert record["inputs"]["left_out"] == [capture.names[3]]
    assert record["warnings"] == ["a sentence"]
    assert record["result"]["texels_seen"] == (np.array(estimate.coverage) > 0).sum()
    intervals = vars(IntervalSummary.of(estimate))
    assert record["result"]["intervals"] == {**intervals, "resolution": [64, 48]}


def test_a_run_that_saw_nothing_is_recorded(tmp_path, vase):
    write_outputs(vase.capture, blind(vase.estimate), tmp_path)
    record = json.loads((tmp_path / "run.json").read_text(), parse_constant=refuse)
    assert record["result"]["intervals"]["seen_part"] == 0
    assert record["result"]["intervals"]["known_part"] == {}


def test_a_run_that_fails_leaves_all_as_it_was(tmp_path, vase):
    write_outputs(vase.capture, vase.estimate, tmp_path, pictures=False)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(OutputError, match=r"entropy\.exr: channel Y has .* NaN"):
        write_outputs(vase.capture, with_entropy(vase.estimate, np.nan), tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
