"""The kernel benchmark on tiny sizes, and whether it would notice what it is there to notice."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import batched
from oracle import posterior as oracle
from studies.kernels import entropy, fit, gather
from studies.kernels import run as kernels
from studies.kernels.end_to_end import run_once
from studies.kernels.memory import resident_formula
from studies.kernels.run import KernelSizes, run_kernels
from studies.kernels.scaling import Range, line, repeated
from studies.kernels.tables import kernel_tables

import svu_mi as svu
from svu_mi.bench import clock
from svu_mi.bench.bars import Bar, bar_table
from svu_mi.bench.clock import measure, run, spread
from svu_mi.bench.fresh import in_new_process
from svu_mi.errors import SvuEnvironmentError
from svu_mi.posterior import PrincipledGrid
from svu_mi.progress import Progress
from svu_mi.visibility import Surface, pack_views, survey

FITS = (fit.Case(20, 8, 100.0, "default"), fit.Case(20, 8, None, "paper"))
TINY = KernelSizes(
    texels=3000, resolution=48, views=6, film=32, spp=1, repeats=1, fits=FITS,
    scaled=Range((16, 32, 48), (3, 6, 12), 24), scaled_views=6, scaled_film=32, skipping_film=32,
    methods=("spectrum",),
)  # fmt: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The whole benchmark on tiny sizes: its folder and record."""
    folder = tmp_path_factory.mktemp("kernels")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "QUICK", TINY)
        patch.setattr(clock, "ENOUGH_S", 0)
        return folder, run_kernels(folder, Progress(), True, None)


# --- the whole ----------------------------------------------------------------------------


def test_a_record_is_json(finished):
    _, record = finished
    assert json.loads(json.dumps(record, allow_nan=False)) == record


def test_all_errors_are_below_their_bars(finished):
    _, record = finished
    errors = [bar for bar in record["bars"] if "error" in bar["what"]]
    assert len(errors) == 3  # entropy of either method, SH fit
    assert all(bar["holds"] for bar in errors), bar_table(errors)
    assert all(0 < row["error"] < 5e-6 for row in record["entropy"]["rows"])
    assert all(0 < row["error"] < 1e-4 for row in record["fit"]["rows"])


def test_warm_runs_compile_nothing_and_cold_ones_everything(finished):
    _, record = finished
    for row in record["entropy"]["rows"] + record["fit"]["rows"]:
        assert row["compile"]["compiled"] >= 1
        assert row["compile"]["seconds"] > 0
        assert row["operations"] > 100
    for found in record["end_to_end"]["methods"].values():
        assert found["warm"]["kernels"] == 0
        assert found["cold"]["kernels"] > 5
        assert found["cold"]["process_seconds"] > found["cold"]["seconds"]


def test_times_are_ordered_and_kernels_take_no_longer_than_the_clock(finished):
    _, record = finished
    for row in record["entropy"]["rows"]:
        inside, wall = row["nanoseconds"], row["wall_nanoseconds"]
        assert 0 < inside["low"] <= inside["median"] <= inside["high"]
        assert inside["median"] <= wall["median"] * 1.5  # clocks of two kinds


def test_the_survey_and_both_bare_ways_trace_the_same_rays(finished):
    gather = finished[1]["gather"]
    assert gather["triangles"] > 70_000
    assert 0 < gather["rays"] < gather["texels"] * gather["views"]
    free = {way["free"] for way in gather["ways"].values()}
    assert len(free) == 1
    assert 0 < free.pop() < gather["rays"]


def test_every_row_is_in_the_tables(finished):
    _, record = finished
    text = kernel_tables(record)
    rows = record["entropy"]["rows"] + record["fit"]["rows"]
    names = [row["label"] for row in rows] + list(record["gather"]["ways"])
    names += [bar["what"] for bar in record["bars"]]
    for found in record["end_to_end"]["methods"].values():
        names += list(found["warm"]["stages"])
    for name in names:
        assert f"| {name} |" in text, name
    for curve in record["scaling"]["curves"]:
        assert f"| {curve['method']} | {curve['what']} |" in text
    widths = [len({line.count("|") for line in part.splitlines()}) for part in text.split("\n\n")
              if part.startswith("|")]  # fmt: skip
    assert widths == [1] * 8, "a row has more or fewer cells than its heads"


def test_stages_of_two_methods_are_in_the_order_of_both(finished):
    record = json.loads(json.dumps(finished[1]))
    methods = record["end_to_end"]["methods"]
    other = json.loads(json.dumps(methods["spectrum"]))
    for how in ("warm", "cold"):
        stages = other[how]["stages"]
        value = stages.pop("Fitting spectra")
        rest = {name: stages.pop(name) for name in ("Computing entropy", "Writing entropy.exr")}
        stages |= {"Gathering statistics": value, **rest}
    methods["angular"] = other
    lines = kernel_tables(record).splitlines()
    names = [line.split("|")[1].strip() for line in lines if line.count("|") == 6]
    first = names.index("Loading photographs")
    stages = names[first : names.index("Writing entropy.exr") + 1]
    assert {"Fitting spectra", "Gathering statistics"} <= set(stages)
    assert stages[-2:] == ["Computing entropy", "Writing entropy.exr"]
    row = next(line for line in lines if line.startswith("| Gathering statistics |"))
    assert row.split("|")[2].strip() == "", "the spectrum has no such stage"


def test_scaling_has_all_points_and_memory_grows_with_texels(finished):
    scaling = finished[1]["scaling"]
    assert {(c["method"], c["what"]) for c in scaling["curves"]} == {
        ("spectrum", what) for what in ("texels", "views")
    }
    for curve in scaling["curves"]:
        n = [point["n"] for point in curve["points"]]
        assert n == sorted(set(n))
        assert len(n) == 3
    assert all(found["allocator"] > 0 for found in scaling["bytes_per_texel"].values())


def test_photographs_are_rendered_once_and_given_ones_are_used(finished):
    folder, _ = finished
    (place,) = (path for path in folder.iterdir() if path.is_dir())
    assert len(list(place.glob("view_*.exr"))) == 6
    capture = svu.load_capture(place)
    assert kernels.folder_of(capture) == place
    assert kernels.folder_of(replace(capture, source=None)) is None
    assert kernels.folder_of(None) is None
    assert not gather.large_enough(capture)


# --- what a comparison notices ------------------------------------------------------------


@pytest.mark.parametrize("case", entropy.CASES[::3], ids=lambda case: case.label)
def test_a_wrong_entropy_is_an_error(case):
    problem = entropy.problem_of(case, 500)
    H = np.array(problem.posterior.entropy())
    assert entropy.largest_error(H, problem) < 5e-6
    assert entropy.largest_error(H + 1e-4, problem) == pytest.approx(1e-4, rel=0.05)
    one_wrong = H.copy()
    one_wrong[problem.checked[7]] += 1e-3
    assert entropy.largest_error(one_wrong, problem) == pytest.approx(1e-3, rel=0.05)
    one_wrong[problem.checked[7]] = np.nan
    assert math.isnan(entropy.largest_error(one_wrong, problem))


def test_the_entropy_of_another_grid_is_an_error():
    case = entropy.CASES[-1]
    problem = entropy.problem_of(case, 200)
    other = replace(case, grid=PrincipledGrid(8, 8, 9))
    wrong = np.array(entropy.problem_of(other, 200).posterior.entropy())
    assert entropy.largest_error(wrong, problem) > 1e-3


def test_a_wrong_kernel_misses_its_bar(monkeypatch):
    """The way through to the table: 0.1 % off is a row of errors and a bar that is not met."""
    right = entropy.hot_path
    compiled = {case.label: {"seconds": 0.0, "compiled": 1, "operations": 1}
                for case in entropy.CASES}  # fmt: skip
    monkeypatch.setattr(entropy, "in_new_process", lambda *_, **__: compiled)
    monkeypatch.setattr(
        entropy, "hot_path", lambda posterior: lambda: 0.999 * right(posterior)()
    )
    found = entropy.measure_entropy(300, 1)
    errors = [bar for bar in found["bars"] if "error" in bar["what"]]
    assert len(errors) == 2
    assert not any(bar["holds"] for bar in errors)
    assert bar_table(errors).count("**no**") == 2


def test_wrong_spectra_are_an_error():
    case = FITS[0]
    blocks = fit.Blocks.draw(case, 300)
    power = np.concatenate(
        [np.array(side) for side in fit.fit(blocks, case.switches)], axis=-1
    )
    assert fit.largest_error(power, blocks, case.switches) < 1e-4
    assert fit.largest_error(1.01 * power, blocks, case.switches) > 9e-3
    penalized = replace(case.switches, penalize_constant=True)
    assert fit.largest_error(power, blocks, penalized) > 1e-3


def test_rays_are_those_of_texels_that_face_the_camera():
    capture = gather.fine_capture(3, 24)
    layout = svu.texels(capture.mesh, 32)
    views, surface = pack_views(capture), Surface.of(layout)
    rays = gather.record_rays(views, surface)
    slot = np.array(rays.slot).reshape(3, layout.count)
    traced = slot != gather.NO_RAY
    np.testing.assert_array_equal(slot[traced], np.arange(rays.count))
    normal = np.array(layout.geometric_normal)[:, np.nonzero(traced)[1]]
    assert (np.array(rays.direction) * normal).sum(axis=0).min() > 0
    assert (traced.sum(axis=0) >= np.array(survey(views, surface).coverage)).all()


# --- parts --------------------------------------------------------------------------------


def test_entropies_are_those_of_the_plain_oracle():
    rng = np.random.default_rng(1618)
    x = rng.exponential(4, (5, 3, 4, 2))
    shared, joint = batched.shared_entropy(x[..., 0]), batched.joint_entropy(x)
    for t in range(5):
        assert shared[t] == pytest.approx(oracle.entropy(oracle.normalize(x[t, ..., 0])))
        p = oracle.of_channels(oracle.joint([x[t, ..., 0], x[t, ..., 1]]), (3, 4))
        assert joint[t] == pytest.approx(oracle.mean_entropy(p))


def test_energies_are_those_of_the_plain_oracle():
    rng = np.random.default_rng(1414)
    S_L, S_B = rng.random((2, 4, 7, 3))
    alpha, Ks = np.array([0.0, 0.2, 0.7]), np.array([0.1, 0.5, 0.6, 1.0])
    decay = np.exp(-2 * (alpha[:, None] * np.arange(1, 7)) ** 2)
    x = batched.spectrum_energy(S_L, S_B, 0.3, decay, Ks)
    for t in range(4):
        for c in range(3):
            d = oracle.distances(S_L[t, :, c], S_B[t, :, c], alpha, Ks)
            np.testing.assert_allclose(x[t, ..., c], oracle.energies(d, 0.3))
    r = oracle.constant_residual(4.0, 9.0, 2.0, 0.5, 0.25)
    got = batched.constant_energy(
        np.array(3.0), np.array(2 * 0.5 * 2 / math.sqrt(math.pi)), np.array(0.25 * 2), 0.3
    )
    assert float(got) == pytest.approx(float(r) ** 2 / (2 * 0.3**2))


def test_the_clock_sees_kernels_and_compilation():
    factor = 1 + np.random.default_rng().random()  # a literal no cache has seen

    def function():
        return dr.sin(dr.arange(mi.Float, 10_000) * factor)

    first = run(function)
    assert first.compiled == 1
    assert first.compile > 0
    timed = measure(function, 3)
    assert (timed["compiled"], timed["launched"]) == (0, 1)
    assert timed["kernel"]["median"] > 0
    assert spread([3.0, 1.0, 2.0], 10) == {"median": 20, "low": 10, "high": 30}


def test_a_line_is_fitted_and_the_exponent_of_the_upper_half():
    found = line([1, 2, 4, 8], [5.0, 7.0, 11.0, 19.0])
    assert found["a"] == pytest.approx(3)
    assert found["b"] == pytest.approx(2)
    assert found["r2"] == pytest.approx(1)
    assert line([1, 2, 4, 8], [1, 4, 16, 64])["slope"] == pytest.approx(2)
    assert line([1, 2, 4, 8], [1, 4, 16, 64])["r2"] < 0.98


def test_views_are_repeated_or_spread(finished):
    folder, _ = finished
    capture = svu.load_capture(folder / "vase_6_32")
    assert repeated(capture, 15).names == (capture.names * 3)[:15]
    assert repeated(capture, 3).names == tuple(capture.names[i] for i in (0, 2, 5))


def test_a_bar_holds_on_its_own_side():
    assert Bar("time", 1.0, 2.0, "s").holds
    assert not Bar("time", 3.0, 2.0, "s").holds
    assert Bar("rate", 3.0, 2.0, "", least=True).holds
    assert not Bar("error", math.nan, 2.0, "").holds
    assert not Bar("rate", math.nan, 2.0, "", least=True).holds


def test_the_formula_of_memory_is_the_readme_s(root):
    readme = (root / "README.md").read_text()
    angular, spectrum, pixel, base = (
        round(resident_formula("angular", 0, 2**20) - 200),
        round(resident_formula("spectrum", 0, 2**20) - 200),
        round(resident_formula("spectrum", 2**20, 0) - 200),
        round(resident_formula("spectrum", 0, 0)),
    )
    line = f"{base} MiB + {pixel} bytes per pixel of all photographs + {angular} bytes per texel"
    assert line in readme and f", {spectrum} with spectra)" in readme


def test_a_failed_process_says_why(tmp_path):
    with pytest.raises(SvuEnvironmentError, match=r"run_once\(\) failed when cold: .*nowhere"):
        in_new_process(run_once, source=str(tmp_path / "nowhere"), resolution=8, method="angular")
