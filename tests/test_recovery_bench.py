"""The recovery benchmark on tiny sizes, and the metrics it judges textures and pictures by."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from svu_mi import scenes
from svu_mi.bench.accuracy import Bench
from svu_mi.bench.captures import FRONT, capture_of, uneven_views
from svu_mi.bench.cells import Cell, own_cells
from svu_mi.bench.recovery import draw_recovery, recovery_tables, run_recovery
from svu_mi.bench.recovery import run as module
from svu_mi.bench.recovery.bars import find_bars
from svu_mi.bench.recovery.cells import TILES, drift, even_tasks, mosaic, own_object, sharing_tasks
from svu_mi.bench.recovery.costs import describe_marks
from svu_mi.bench.recovery.judge import Judge, Relit
from svu_mi.bench.recovery.measure import Mark, step_seconds
from svu_mi.bench.recovery.options import Options
from svu_mi.bench.recovery.rows import PATH, ROWS, SH, SH_SHARING, choose_rows, find_row
from svu_mi.bench.sizes import RecoverySizes, Sizes
from svu_mi.capture.scene import to_world
from svu_mi.cli.main import main
from svu_mi.errors import OptionError, ShapeError
from svu_mi.metrics import image_error, psnr, texel_error, texture_psnr
from svu_mi.metrics.images import ssim_map
from svu_mi.metrics.textures import CEILING_DB
from svu_mi.progress import Progress
from svu_mi.recovery.textures import lay_out, uniform
from svu_mi.surface import texels

# Without rows that only add sharing to another.
LABELS = tuple(row.label for row in ROWS if not row.sharing or row is SH_SHARING)
TINY = RecoverySizes(
    rows=LABELS, even_cells=1, relit_views=1, relit_spp=2, dense_views=8, front=4, back=1,
    path_cells=0, repeats=1, step_views=(4, 8), step_film=24, step_steps=30, turns=1, steps=30,
    soak_texels=24, soak_views=6, soak_film=24, scale=0.05, cold=False,
)  # fmt: skip
PICTURES = Sizes(views=6, film=32, spp=4, texels=32, recovery=TINY)
CELLS = own_cells(["vase"], ["window"])


def bench_in(folder, **changes):
    return Bench(folder, PICTURES, Progress(), quick=True, **changes)


# --- metrics ------------------------------------------------------------------------------


def test_psnr_is_that_of_the_definition():
    rng = np.random.default_rng(771204316)
    truth = rng.uniform(size=(50, 3))
    assert psnr(truth + 0.1, truth) == pytest.approx(20)  # MSE 1e-2
    assert psnr(2 * truth, 2 * truth + 0.2, peak=2) == pytest.approx(20)
    noisy = truth + rng.normal(scale=0.05, size=truth.shape)
    by_hand = 10 * np.log10(truth.size / ((noisy - truth) ** 2).sum())
    assert psnr(noisy, truth) == pytest.approx(by_hand)


def test_without_any_error_psnr_is_a_number():
    assert psnr([0.5], [0.5]) == CEILING_DB


@pytest.mark.parametrize(
    ("found", "truth", "peak", "error"),
    [
        ([1.0], [1.0, 2.0], 1, ShapeError),
        ([], [], 1, ShapeError),
        ([np.nan], [1.0], 1, OptionError),
        ([1.0], [1.0], 0, OptionError),
    ],
)
def test_psnr_refuses_what_it_cannot_compare(found, truth, peak, error):
    with pytest.raises(error):
        psnr(found, truth, peak)


def test_the_average_counts_every_parameter_the_same():
    truth = {"base_color": np.zeros((4, 3)), "roughness": np.zeros(4)}
    found = {"base_color": np.full((4, 3), 0.1), "roughness": np.full(4, 0.01)}
    assert texture_psnr(found, truth) == pytest.approx(
        {"base_color": 20, "roughness": 40, "average": 30}
    )
    np.testing.assert_allclose(texel_error(found, truth), 0.055)  # (0.1 + 0.01) / 2
    with pytest.raises(ShapeError, match="base_color"):
        texture_psnr({"roughness": found["roughness"]}, truth)


def ssim_of_windows(found, truth):
    """SSIM as the sum over each 11 x 11 window that Wang et al. write down (Eq. 13 to 16)."""
    at = np.arange(-5, 6)
    weight = np.exp(-(at**2) / (2 * 1.5**2))
    weight = np.outer(weight, weight)
    weight /= weight.sum()
    padded = [np.pad(x, ((5, 5), (5, 5)), mode="symmetric") for x in (found, truth)]
    result = np.empty(found.shape)
    for i, j in np.ndindex(*found.shape):
        x, y = (p[i : i + 11, j : j + 11] for p in padded)
        mx, my = (weight * x).sum(), (weight * y).sum()
        sx, sy = (weight * (x - mx) ** 2).sum(), (weight * (y - my) ** 2).sum()
        sxy = (weight * (x - mx) * (y - my)).sum()
        c1, c2 = 0.01**2, 0.03**2
        result[i, j] = (2 * mx * my + c1) * (2 * sxy + c2)
        result[i, j] /= (mx**2 + my**2 + c1) * (sx + sy + c2)
    return result


def test_ssim_is_that_of_wang_et_al():
    rng = np.random.default_rng(40927715)
    truth = rng.uniform(size=(14, 17))
    found = np.clip(truth + rng.normal(scale=0.2, size=truth.shape), 0, 1)
    # Border pixels are mirrored in both, so every pixel can be compared.
    np.testing.assert_allclose(
        ssim_map(found[..., None], truth[..., None])[..., 0], ssim_of_windows(found, truth),
        rtol=1e-9,
    )  # fmt: skip


def test_pictures_are_compared_on_the_object_only_and_at_any_exposure():
    rng = np.random.default_rng(5582210)
    truth, mask = rng.uniform(0.2, 2, size=(16, 16, 3)), np.zeros((16, 16), bool)
    mask[4:12, 4:12] = True
    found = truth * 1.1
    same = image_error(truth, truth, mask)
    assert (same.psnr_hdr, same.psnr_ldr, same.ssim) == (CEILING_DB, CEILING_DB, pytest.approx(1))
    error = image_error(found, truth, mask)
    assert 15 < error.psnr_hdr < 40
    found[0, 0] = np.nan  # not on the object
    assert image_error(found, truth, mask) == error
    brighter = image_error(1000 * found, 1000 * truth, mask)
    assert brighter.psnr_hdr == pytest.approx(error.psnr_hdr)
    assert brighter.ssim == pytest.approx(error.ssim)
    with pytest.raises(ShapeError, match="empty"):
        image_error(truth, truth, np.zeros((16, 16), bool))


# --- objects, cells, views ----------------------------------------------------------------


def test_tiles_repeat_and_drift_does_not():
    color, rough, metal = mosaic()
    materials = np.unique(np.dstack([color, rough, metal]).reshape(-1, 5), axis=0)
    assert len(materials) == len(TILES)
    values = np.dstack([part.reshape(*rough.shape, -1) for part in drift()])
    assert 0 <= values.min() < values.max() <= 1
    assert len(np.unique(values.reshape(-1, 5), axis=0)) > 0.9 * rough.size


def test_an_object_of_our_own_is_what_was_painted(tmp_path):
    """Through the files that are written: 8 bits, so the truth is within half a step of 1/255."""
    folder = own_object("mosaic", tmp_path)
    image = scenes.FOLDER / "lights" / "window.exr"
    defines = {"object": str(folder), "environment": str(image), "max_depth": "2"}
    cell = Cell("mosaic", "window", scenes.path("object"), defines)
    capture = capture_of(cell, PICTURES, tmp_path / "capture", Progress())
    grid = texels(capture.mesh, 256)
    judge = Judge.of(capture, grid, poor=2)
    color, rough, metal = mosaic()
    index = grid.index.numpy()
    true = judge.truth.values
    np.testing.assert_allclose(true["roughness"], rough.ravel()[index], atol=3e-3)
    np.testing.assert_allclose(true["metallic"], metal.ravel()[index], atol=3e-3)
    # Steps of sRGB are at most 2.5 times as wide near white.
    np.testing.assert_allclose(true["base_color"], color.reshape(-1, 3)[index], atol=6e-3)


def test_every_cell_is_relit_by_a_light_of_its_own_that_is_another(tmp_path):
    tasks = [*even_tasks(own_cells(["knot"]), None, tmp_path),
             *sharing_tasks(None, tmp_path, quick=False)]  # fmt: skip
    assert {task.group for task in tasks} == {"even", "repeated", "varied"}
    assert len({task.name for task in tasks}) == len(tasks)
    for task in tasks:
        assert task.relit.object == task.cell.object
        assert task.relit.light != task.cell.light
        assert task.relit.defines["max_depth"] == "2"


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    return capture_of(CELLS[0], PICTURES, folder, Progress())


def test_uneven_views_crowd_on_one_side(capture):
    found = uneven_views(capture, 3, 1)
    assert found.count == 4
    assert len(set(found.names)) == 4
    axis = np.array(FRONT) / np.linalg.norm(FRONT)

    def cosines(views):
        origins = np.array([to_world(sensor)[:3, 3] for sensor in views.sensors])
        return origins / np.linalg.norm(origins, axis=1, keepdims=True) @ axis

    best = np.sort(cosines(capture))[::-1]
    np.testing.assert_allclose(np.sort(cosines(found))[::-1][:3], best[:3], atol=1e-6)
    with pytest.raises(OptionError, match="too many"):
        uneven_views(capture, 5, 2)


# --- judging ------------------------------------------------------------------------------


def test_true_textures_have_no_error_and_others_do(capture):
    grid = texels(capture.mesh, 48)
    judge = Judge.of(capture, grid, poor=2)
    true = lay_out(grid, judge.truth.values)
    best, grey = judge.judge(true), judge.judge(uniform(grid))
    assert best["psnr"]["average"] > 99
    assert grey["psnr"]["average"] < 20
    seen = judge.coverage > 0
    by_hand = np.mean((judge.truth.values["roughness"][seen] - 0.5) ** 2)
    assert grey["psnr"]["roughness"] == pytest.approx(-10 * np.log10(by_hand), rel=1e-6)
    (task,) = even_tasks(CELLS, None, capture.source)
    relit = Relit.of(capture, task.relit, 2, 16)
    best, grey = relit.judge(true), relit.judge(uniform(grid))
    for name in ("psnr_hdr", "psnr_ldr", "ssim"):
        assert best[name] > grey[name]


def test_the_truth_under_its_own_light_is_the_photograph(capture):
    """Relit by the light of the photographs, with the same samples: the same picture."""
    relit = Relit.of(capture, CELLS[0], 6, PICTURES.spp, PICTURES.seed)
    for picture, photograph, mask in zip(relit.truth, capture.images, relit.masks, strict=True):
        np.testing.assert_allclose(picture[mask], photograph[mask], rtol=2e-3)  # half floats


# --- the whole ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Nearly every row on one cell, sharing on another, and the costs: folder and record."""
    folder = tmp_path_factory.mktemp("recovery")
    seen = []
    record = run_recovery(
        bench_in(folder), CELLS, finished=lambda found: seen.append(len(found["cells"]))
    )
    return folder, record, seen


def test_every_row_has_figures(finished):
    _, record, seen = finished
    assert record["failed"] == []
    assert [cell["group"] for cell in record["cells"]] == ["even", "repeated"]
    assert seen == [1, 2, 2]  # told after each cell, and at the end
    even, repeated = record["cells"]
    assert list(even["rows"]) == list(LABELS)
    assert list(repeated["rows"]) == [SH.label, SH_SHARING.label]
    for cell in record["cells"]:
        assert 0 < cell["seen"] <= cell["texels"]
        assert cell["relit"] != cell["light"]
        for label, row in cell["rows"].items():
            assert row["seconds"] > 0
            assert row["compiled"] == 0, label
            assert row["steps"] >= 1
            assert 0 < row["psnr"]["average"] < CEILING_DB
            assert set(row["psnr"]) == {"base_color", "roughness", "metallic", "average"}
            assert -1 <= row["relit"]["ssim"] <= 1
            assert -1 <= row["entropy_correlation"] <= 1
        assert cell["truth_relit"]["psnr_ldr"] > max(
            row["relit"]["psnr_ldr"] for row in cell["rows"].values()
        )


def test_steps_are_timed_and_long_runs_compile_nothing(finished):
    costs = finished[1]["costs"]
    assert all(one["seconds"] > 0 for one in costs["sharing"].values())
    assert len(costs["sharing"]) == 2
    few, many = costs["views"]
    assert (few["views"], many["views"]) == (4, 8)
    for found in costs["long"].values():
        assert found["steps"] == TINY.steps
        assert found["compiled"] == 0
        assert found["seconds"] > 0


def test_tables_and_plot_show_what_was_found(finished, tmp_path):
    _, record, _ = finished
    text = recovery_tables(json.loads(json.dumps(record, default=vars)))
    for word in (*LABELS, "vase / window", "mosaic / window", "hardly seen"):
        assert word in text
    assert "nan" not in text.lower().replace("dominant", "")
    (path,) = draw_recovery(tmp_path, record)
    assert path.stat().st_size > 10_000


def test_a_second_run_computes_nothing(finished, monkeypatch):
    folder, record, _ = finished

    def refuse(*_, **__):
        raise AssertionError("a finished row was computed again")

    monkeypatch.setattr(module.Setting, "measure", refuse)
    monkeypatch.setattr(module, "measure_costs", refuse)
    again = run_recovery(bench_in(folder), CELLS)
    assert again["cells"] == record["cells"]
    assert again["bars"] == record["bars"]


def test_results_of_another_version_are_taken_up_only_if_asked_for(finished, monkeypatch):
    folder, record, _ = finished
    calls = []
    monkeypatch.setattr("svu_mi.bench.recovery.run.code_now", lambda: "other")
    same = record["cells"][0]["rows"][SH.label]
    monkeypatch.setattr(module.Setting, "measure", lambda _, row: calls.append(row) or same)
    one = Options(groups=("even",), rows=(SH.label,))
    kept = run_recovery(bench_in(folder), CELLS, replace(one, keep=True))
    stored = run_recovery(bench_in(folder), CELLS, replace(one, stored=True))
    assert calls == []
    assert kept["cells"] == stored["cells"] != []
    run_recovery(bench_in(folder), CELLS, one)
    assert calls == [SH]


def test_a_folder_without_results_gives_an_empty_table(tmp_path):
    record = run_recovery(bench_in(tmp_path), CELLS, Options(stored=True))
    assert record["cells"] == []
    assert record["costs"] is None
    assert "Recovery" not in recovery_tables(record)
    assert draw_recovery(tmp_path, record) == []


# --- parts --------------------------------------------------------------------------------


def test_rows_are_found_by_label_and_cheap_ones_come_first():
    assert find_row("path") is PATH
    assert choose_rows(["path", "SH (ours)"], "even") == (SH, PATH)
    assert choose_rows([], "repeated", traced=False) == (SH, SH_SHARING)
    with pytest.raises(OptionError, match="no row 'poth'"):
        choose_rows(["poth"], "even")
    with pytest.raises(OptionError, match="no group"):
        Options(groups=("odd",))
    assert len({row.slug for row in ROWS}) == len(ROWS)


def test_bars_tell_a_hit_from_a_miss(finished):
    record = json.loads(json.dumps(finished[1], default=vars))
    even = record["cells"][0]
    for label, average, seconds in (
        ("SH (ours)", 20, 1),
        ("path", 20.4, 16),
        ("SH (paper)", 19, 2),
    ):
        even["rows"][label]["psnr"]["average"] = average
        even["rows"][label]["seconds"] = seconds
    first = {bar["what"]: bar for bar in find_bars(record)}
    over = next(bar for what, bar in first.items() if what.startswith("SH (ours) over path"))
    assert over["value"] == pytest.approx(-0.4)
    assert over["holds"]
    part = next(bar for what, bar in first.items() if "part of path" in what and "ours" in what)
    assert part["value"] == pytest.approx(1 / 16)
    assert part["holds"]
    even["rows"]["path"]["psnr"]["average"] = 20.6
    second = {bar["what"]: bar for bar in find_bars(record)}
    assert not next(b for w, b in second.items() if w.startswith("SH (ours) over path"))["holds"]


def test_marks_show_kernels_memory_and_time_per_step():
    marks = [Mark(10 * k, 2.0 + 0.1 * k, 7 + (k > 20), 100.0 + k) for k in range(1, 31)]
    found = describe_marks(marks, 300)
    assert found["steps"] == 300
    assert found["compiled"] == 1
    assert found["grown"] == pytest.approx(27)  # from step 30 to step 300
    assert found["seconds"] == pytest.approx(0.01)
    assert np.isnan(step_seconds(marks[:2]))


def test_the_command_line_knows_groups_and_rows(tmp_path, capsys):
    assert main(["bench", "recovery", "--quick", "--stored", "-o", str(tmp_path)]) == 0
    assert (tmp_path / "bench.md").exists()
    assert main(["bench", "recovery", "--quick", "--groups", "odd", "-o", str(tmp_path)]) == 2
    assert "no group" in "".join(capsys.readouterr())
