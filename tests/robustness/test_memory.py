"""Memory is asked about before it is taken: what commands need, and what there is."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from support.announced import RUN, announced_and_taken, prepared, words
from support.helpers import fails, python, run

import svu_mi as svu
from svu_mi import scenes
from svu_mi.calibration.light.light_options import LightOptions
from svu_mi.capture import mesh
from svu_mi.capture.loading import plan_capture
from svu_mi.capture.rendering import plan_render
from svu_mi.cli.loading import LitCommand, light_search_need, photograph_memory
from svu_mi.core import memory
from svu_mi.core.memory import Need, Sizes
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError, SvuEnvironmentError

SIXTY = [(6000, 4000)] * 60


def needed(command, photographs, resolution=(0, 0), model="default", **sizes) -> Need:
    return Need(command, Sizes(photographs, **sizes), resolution, model)


def machine(monkeypatch, free: float, space: float | None = None) -> None:
    """Pretend that so much is free, and that a process of nothing may use so much."""
    monkeypatch.setattr(memory, "free_memory", lambda: int(free))
    monkeypatch.setattr(memory, "resident", lambda: 0)
    monkeypatch.setattr(memory, "address_space", lambda: space and (int(space), 0))


def refused(need: Need) -> str:
    with pytest.raises(CaptureError) as caught:
        need.require("capture")
    return str(caught.value)


# --- what is announced, and refused -------------------------------------------------------


def test_photographs_that_do_not_fit_are_to_be_shrunk(monkeypatch):
    machine(monkeypatch, 23e9)
    need = needed("entropy", SIXTY, (512, 512))
    assert need.sentence() == "Needs up to 34 GB of memory; 23 GB available"
    assert refused(need) == (
        "capture: needs 34 GB of memory, 23 GB available; svu import --shrink 2 needs 9.5 GB."
    )


def test_texels_that_do_not_fit_are_to_be_fewer(monkeypatch):
    machine(monkeypatch, 2e9)
    assert refused(needed("recover", [(512, 512)] * 10, (2048, 2048))) == (
        "capture: needs 12 GB of memory, 2 GB available; --resolution 512 needs 1.6 GB."
    )
    assert refused(needed("entropy", [(512, 512)] * 10, (4096, 4096))) == (
        "capture: needs 4.6 GB of memory, 2 GB available; --resolution 2048 needs 1.7 GB."
    )
    need = needed("recover", SIXTY, (2048, 1024))
    assert refused(need).endswith("; svu import --shrink 7 and --resolution 512 256 needs 1.8 GB.")


def test_visibility_of_many_photographs_is_counted():
    need = needed("entropy", [(256, 256)] * 1000, (2048, 2048), charts=0.945)
    assert 4.2e9 <= need.bytes <= 4.6e9  # a process took 4.16e6 KiB


@pytest.mark.parametrize("given", [None, "light.exr"])
def test_a_search_for_the_light_is_counted_only_where_it_happens(given):
    asked, dark = [], Sizes([(8, 8)] * 3, lit=False)
    small = partial(Need, "entropy", resolution=(8, 8), model="default")

    def load(_, need, *others):
        asked.append(need)
        raise InterruptedError

    command = SimpleNamespace(light=given, load=load)
    with pytest.raises(InterruptedError):
        LitCommand.load_with_light(command, Progress(), small, (8, 8))
    assert (asked[0](dark).bytes > small(dark).bytes) == (given is None)
    assert asked[0](replace(dark, lit=True)).bytes == small(dark).bytes


def test_photographs_leave_memory_for_texels_by_default(monkeypatch, shot):
    machine(monkeypatch, 4e9)

    need = partial(Need, "recover", resolution=(1024, 1024), model="default")
    plan_memory = partial(photograph_memory, Progress(), "capture", need)
    many = Sizes([(1000, 1000)] * 90, memory=2e9, asked=False)
    assert plan_memory(many) == 0
    with pytest.raises(CaptureError, match=r"^capture: needs [\d.]+ GB of memory, 4 GB available"):
        plan_memory(replace(many, asked=True))
    few = replace(many, photographs=many.photographs[:10])
    assert plan_memory(few) == few.memory
    assert plan_capture(shot).read(0.0).buffer.file is not None
    assert svu.load_capture(shot).buffer.file is None


def test_error_states_if_no_size_would_fit(monkeypatch):
    machine(monkeypatch, 0.3e9)
    assert refused(needed("check", SIXTY)) == (
        "capture: needs 34 GB of memory, 0.3 GB available; use a machine with more memory."
    )


def test_address_space_is_checked_too(monkeypatch):
    machine(monkeypatch, 23e9, 2e9)
    said = refused(needed("entropy", [(512, 512)] * 60, (512, 512)))
    assert re.fullmatch(
        r"capture: needs [\d.]+ GB of address space, but ulimit -v allows 2 GB; raise the limit; "
        r"--resolution 256 needs 0.98 GB of memory\.",
        said,
    ), said


def test_unknown_free_memory_refuses_nothing(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: None)
    monkeypatch.setattr(memory, "address_space", lambda: None)
    needed("entropy", SIXTY * 1000, (4096, 4096)).require()
    memory.require_start()
    assert needed("check", []).sentence() == "Needs up to 0.62 GB of memory"


def test_too_little_memory_to_start_is_reported(monkeypatch):
    machine(monkeypatch, 0.1e9)
    with pytest.raises(SvuEnvironmentError, match=r"^needs 0.25 GB of memory to start, 0.1 GB av"):
        memory.require_start()


# --- what there is ------------------------------------------------------------------------


@pytest.fixture
def proc(tmp_path, monkeypatch):
    """A machine with 4 GB free, whose process is in no group."""
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal: 9 kB\nMemAvailable:    4000000 kB\n")
    monkeypatch.setattr(memory, "MEMINFO", meminfo)
    monkeypatch.setattr(memory, "PROCESS", tmp_path)
    monkeypatch.setattr(memory, "GROUPS", tmp_path / "groups")
    return tmp_path


def group(folder, **files: object) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name.replace("_", ".", 1)).write_text(f"{content}\n")


def test_free_memory_is_that_of_the_machine(proc):
    assert memory.free_memory() == 4_096_000_000


def test_free_memory_is_what_this_process_is_allowed(proc, monkeypatch):
    """As one of several: less what it has taken itself."""
    monkeypatch.setattr(memory, "_allowed", [])
    (proc / "status").write_text("VmRSS: 900 kB\nRssAnon: 300 kB\n")
    memory.allow(1_000_000)
    assert memory.free_memory() == 1_000_000 - 300 * 1024
    memory.allow(1_000)
    assert memory.free_memory() == 0


def test_free_memory_is_that_of_the_container(proc):
    group(proc / "groups", memory_max="max")
    assert memory.free_memory() == 4_096_000_000
    group(proc / "groups", memory_max=123456)
    assert memory.free_memory() == 123456


def test_free_memory_is_limited_by_tightest_control_group(proc):
    """What a group has used is gone, files aside, which are dropped when it is short."""
    (proc / "cgroup").write_text("0::/user.slice/session.scope\n")
    root = proc / "groups"
    group(root / "user.slice", memory_max=3_000_000_000, memory_current=2_500_000_000)
    group(root / "user.slice" / "session.scope", memory_max="max", memory_current=1_000_000_000)
    assert memory.free_memory() == 500_000_000
    group(root / "user.slice", memory_stat="anon 7\ninactive_file 150000000\nactive_file 50000000")
    assert memory.free_memory() == 700_000_000


def test_free_memory_is_that_of_an_old_group(proc):
    (proc / "cgroup").write_text("5:devices:/\n4:memory,hugetlb:/job\n0::/\n")
    folder = proc / "groups" / "memory" / "job"
    group(folder, memory_limit_in_bytes=2_000_000_000, memory_usage_in_bytes=1_900_000_000)
    group(folder, memory_stat="total_inactive_file 5")
    assert memory.free_memory() == 100_000_005


# --- commands -----------------------------------------------------------------------------

COMMANDS = ("entropy", "recover", "guide", "report", "check", "compare", "light")
linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@linux
@pytest.mark.parametrize("command", ["entropy", "import", "demo"])
def test_half_of_the_address_space_is_refused_in_a_sentence(command, tmp_path):
    place = () if command == "demo" else (tmp_path,)
    done = python("-c", RUN, 0.6e9, command, *place)
    assert done.returncode == 2
    assert re.fullmatch(
        r"svu: needs [\d.]+ GB of address space to start, but ulimit -v allows 0.6 GB; raise the "
        r"limit.\n",
        done.stderr,
    ), done.stderr


@linux
@pytest.mark.parametrize(("command", "space"), [
    ("entropy", 1.4e9),  # works tile by tile: 1.9e9 are enough
    pytest.param("guide", 1.4e9, marks=pytest.mark.slow),
])  # fmt: skip
def test_too_little_address_space_for_texels_is_refused_early(command, space, shot, tmp_path):
    """It was signal 11, in the middle of the work."""
    done = python("-c", RUN, space, *words(command, shot, tmp_path, 1024))
    assert done.returncode == 2, done.stderr
    line = done.stderr.splitlines()[-1]
    if line.startswith("svu: --resolution: 1024 x 1024 texels take at least "):
        return  # not even a grid of them fits
    assert line.startswith(f"svu: {shot}: needs "), line
    assert f"GB of address space, but ulimit -v allows {space / 1e9:.2g} GB; raise" in line


@linux
def test_films_above_the_address_space_are_not_rendered(tmp_path):
    """It was signal 11, too, after half of the views."""
    place = ("render", scenes.path("vase"), "--views", 20, "--resolution", 2048)
    done = python("-c", RUN, 1.3e9, *place, "-D", "light=window", "-o", tmp_path / "out")
    assert done.returncode == 2, done.stderr
    assert "20 photographs of up to 2048 x 2048 pixels take at least" in done.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_half_of_the_memory_is_refused_in_a_sentence(command, shot, tmp_path, capsys, monkeypatch):
    """As in a control group that gives no more than what the process has by then."""
    monkeypatch.setattr(memory, "free_memory", lambda: 0)
    monkeypatch.setattr(memory, "resident", lambda: int(0.26e9))
    line = fails(capsys, *words(command, shot, tmp_path, 256))
    assert re.fullmatch(
        rf"svu: {re.escape(str(shot))}: needs [\d.]+ GB of memory, 0.26 GB available; [^;]+\.", line
    ), line
    assert not (tmp_path / "out.html").exists() and not (tmp_path / "out" / "run.json").exists()


OTHERS = {"render": "vase.xml", "import": "", "export": "recovered"}  # what is named


@pytest.mark.parametrize("command", OTHERS)
def test_commands_without_photographs_refuse_too(command, tmp_path, capsys, monkeypatch):
    words = prepared(command, tmp_path, 24)
    capsys.readouterr()
    monkeypatch.setattr(memory, "free_memory", lambda: 0)
    monkeypatch.setattr(memory, "resident", lambda: int(0.252e9))
    line = fails(capsys, *words)
    refusal = rf"svu: \S*{OTHERS[command]}: needs [\d.]+ GB of memory, 0.25 GB available; [^;]+\."
    assert re.fullmatch(refusal, line), line
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize("command, films, texels, peak", [
    ("check", (192,) * 24, 0, 0.46e9), ("check", (384,) * 24, 0, 0.65e9),
    ("inpaint", (192,) * 24, 256, 0.58e9), ("inpaint", (384,) * 24, 600, 1.84e9),
    ("import", (256,) * 3, 0, 0.28e9),
])  # fmt: skip
def test_estimates_exceed_measured_peaks(command, films, texels, peak):
    """The vase, whose charts cover 99 %, and an import without light."""
    sides = [(side, side) for side in films]
    estimate = needed(command, sides, (texels, texels), charts=0.99)
    assert peak < estimate.bytes < 1.4 * peak


def test_each_command_names_a_remedy(monkeypatch):
    machine(monkeypatch, 1e9)
    films = [(2000, 1000)] * 20
    assert refused(needed("render", films, model="")).endswith(
        "; rendering at most 1000 x 500 pixels per film needs 0.76 GB."
    )
    assert refused(needed("import", films, model="")).endswith(
        "; reading photographs of at most 1000 x 500 pixels needs 0.92 GB."
    )
    assert refused(needed("export", (), (2048, 2048), model="")).endswith(
        "; svu recover --resolution 1024 needs 0.92 GB."
    )


@linux
@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "resolution"),
    [
        *((command, 256) for command in COMMANDS if command != "light"),
        ("entropy", 640),  # in tiles
    ],  # ``support.announced`` has three sizes of each
)
def test_no_command_takes_more_than_it_has_announced(command, resolution, shot, tmp_path):
    announced, peak = announced_and_taken(*words(command, shot, tmp_path, resolution))
    assert announced / 2 < peak <= announced, (announced, peak)


@linux
@pytest.mark.slow
@pytest.mark.parametrize("command", OTHERS)
def test_rendering_importing_and_exporting_take_no_more_either(command, tmp_path):
    announced, peak = announced_and_taken(*prepared(command, tmp_path, 1024))
    assert announced / 2 < peak <= announced, (announced, peak)


@linux
@pytest.mark.slow
def test_an_estimate_of_the_light_takes_no_more(tmp_path):
    views = "--views", 24, "--resolution", 48, "--spp", 4, "-D", "light=window"
    assert run("render", scenes.path("vase"), *views, "-o", tmp_path / "shot") == 0
    announced, peak = announced_and_taken(*words("light", tmp_path / "shot", tmp_path, 256))
    assert announced / 2 < peak <= announced, (announced, peak)


def test_many_texels_count_in_an_estimate_of_the_light():
    """From 40 photographs, half of which show a texel, this one takes 1.07 GB."""
    options = LightOptions(texels=10_000, depths=((64, 1),))
    need = light_search_need(Sizes([(128, 128)] * 40), (256, 256), options)
    assert 1.07e9 < need.bytes < 2e9


def test_texels_that_no_chart_covers_take_next_to_nothing():
    full = needed("recover", [(64, 64)], (4096, 4096))
    quarter = needed("recover", [(64, 64)], (4096, 4096), charts=0.25)
    fixed = needed("recover", [(64, 64)]).bytes
    assert 0.25 <= (quarter.bytes - fixed) / (full.bytes - fixed) < 0.3


def test_chart_coverage_is_read_from_the_mesh(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    for side, part in ((0.5, 0.25), (1.0, 1.0)):
        made = mesh.make_mesh("plate", mesh.MeshArrays(corners, faces, None, side * corners[:, :2]))
        assert mesh.chart_coverage(made) == pytest.approx(min(part * mesh.MARGIN, 1))
    bare = mesh.make_mesh("plate", mesh.MeshArrays(corners, faces, None, None))
    assert mesh.chart_coverage(bare) == 1
    plan = plan_render(scenes.path("vase"), 1)
    assert plan.sizes.charts < 0.995 and replace(plan, unwrap=True).sizes.charts == 1
