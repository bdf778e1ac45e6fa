"""Stages: records, and output on terminals and in log files."""

from __future__ import annotations

import io
import time

import drjit as dr
import mitsuba as mi
import pytest
from rich.console import Console

from svu_mi.core import progress as progress_module
from svu_mi.core.progress import COMPILING, Progress


def console(*, terminal: bool) -> tuple[Console, io.StringIO]:
    stream = io.StringIO()
    return Console(file=stream, force_terminal=terminal, width=100, color_system=None), stream


def test_a_stage_records_its_seconds_and_adds_up():
    progress = Progress()
    for name in ("first", "second", "first"):
        with progress.stage(name):
            time.sleep(0.03 if name == "first" else 0)
    assert list(progress.timings) == ["first", "second"]
    assert 0.06 <= progress.timings["first"] < 0.5
    assert progress.timings["second"] < progress.timings["first"]


def test_without_a_console_nothing_is_shown(capfd):
    with Progress().stage("silent") as stage:
        stage.update(1, 2)
        stage.state("waiting")
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def test_a_log_file_gets_one_plain_line_per_stage():
    where, stream = console(terminal=False)
    progress = Progress(where)
    with progress.stage("Fitting [bold]spectra[/]") as stage:
        stage.update(1, 2)
        stage.state("waiting")
    assert "\x1b" not in stream.getvalue() and "\r" not in stream.getvalue()
    lines = stream.getvalue().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("Fitting [bold]spectra[/]: 0.0")


def test_a_log_file_gets_a_line_now_and_then_about_a_long_stage(monkeypatch):
    where, stream = console(terminal=False)
    monkeypatch.setattr(progress_module, "PERIOD", 0.1)
    with Progress(where).stage("Rendering photographs") as stage:
        for view in range(1, 6):
            if view in (2, 5):
                time.sleep(0.11)
            stage.update(view, 5)
    lines = stream.getvalue().splitlines()
    assert lines[:-1] == ["Rendering photographs: 2/5"]  # the end of the stage prints the last line
    assert lines[-1].startswith("Rendering photographs: 0.2")


def test_a_terminal_shows_a_bar_and_the_state():
    where, stream = console(terminal=True)
    with Progress(where).stage("Gathering", total=4) as stage:
        stage.update(1, 4)
        stage.state("loading view 2")
        time.sleep(0.25)  # ten updates of the live line per second
    shown = stream.getvalue()
    assert "Gathering" in shown and "loading view 2" in shown
    assert COMPILING not in shown


def test_silence_is_explained_by_compilation(monkeypatch):
    monkeypatch.setattr(progress_module, "PATIENCE", 0.1)
    for compiled in (0, 3):
        monkeypatch.setattr(progress_module, "compiled_kernels", lambda n=compiled: n)
        where, stream = console(terminal=True)
        with Progress(where).stage("Fitting"):
            time.sleep(0.35)
        assert (COMPILING in stream.getvalue()) == (compiled > 0)


def test_the_live_line_is_one_line_on_a_narrow_terminal(monkeypatch):
    monkeypatch.setattr(progress_module, "PATIENCE", 0.0)
    monkeypatch.setattr(progress_module, "compiled_kernels", lambda: 1)
    where, stream = console(terminal=True)
    where.width = 40
    with Progress(where).stage("Fitting"):
        time.sleep(0.15)
    live = stream.getvalue().rpartition("Fitting: ")[0]
    assert "Fitting" in live and live.count("\n") == 1  # at the end


def test_a_stage_that_fails_is_said_but_not_recorded():
    where, stream = console(terminal=False)
    progress = Progress(where)
    with pytest.raises(ZeroDivisionError), progress.stage("Dividing"):
        _ = 1 / 0
    assert progress.timings == {}
    assert "Dividing: failed after" in stream.getvalue()


def test_kernels_are_counted_once_they_had_to_be_compiled():
    progress = Progress()
    # A constant that is in no kernel of the disk cache.
    odd = time.time_ns() % 1_000_003 / 1_000_003
    for name in ("cold", "warm"):
        with progress.stage(name):
            dr.eval(dr.sin(dr.arange(mi.Float, 1000) * odd))
    assert progress.kernels == {"cold": 1, "warm": 0}
