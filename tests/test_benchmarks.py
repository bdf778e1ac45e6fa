"""Every table of BENCHMARKS.md has a command that can be given, and says how long it takes."""

from __future__ import annotations

import argparse
import re
import runpy
import shlex
import sys
from importlib import import_module

import numpy as np
import pytest
import tyro

from svu_mi.bench import BENCHMARKS
from svu_mi.bench.cells import own_cells
from svu_mi.cli.main import main
from svu_mi.metrics import ground_truth

TIME = re.compile(r"# .*?\d+ (seconds?|minutes?|hours?)\b")
TABLE = re.compile(r"^\| ?---|^\|---", re.MULTILINE)
STARTS = ("svu ", "python ", "PYTHONPATH=", "make ")


def sections(root) -> dict[str, str]:
    """The text of every section by its heading."""
    text = (root / "BENCHMARKS.md").read_text(encoding="utf-8")
    parts = re.split(r"^## (.+)$", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def commands(text: str) -> list[str]:
    """Commands of indented blocks, with their comments; continued lines are one."""
    block = "\n".join(line[4:] for line in text.splitlines() if line.startswith("    "))
    lines = re.sub(r"\\\n\s*", "", block).splitlines()
    return [line for line in lines if line.startswith(STARTS)]


class Parsed(BaseException):
    """The options of a command were read; no command takes it for an error."""


@pytest.fixture
def parse(root, monkeypatch):
    """Read the options of a command as it would, and stop it there."""
    cli, known = tyro.cli, argparse.ArgumentParser.parse_known_args

    def stop_cli(*arguments, **options):
        raise Parsed(cli(*arguments, **options))

    def stop(parser, *_):
        found, unknown = known(parser)
        assert not unknown, unknown
        raise Parsed(found)

    monkeypatch.setattr(tyro, "cli", stop_cli)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)
    monkeypatch.syspath_prepend(root / "tests" / "records")

    def run(line):
        words = shlex.split(line.removeprefix("PYTHONPATH=tests "), comments=True)
        program, *rest = words
        if program == "make":
            targets = (root / "Makefile").read_text(encoding="utf-8")
            assert all(f"\n{target}:" in targets for target in rest), rest
        elif rest[:2] == ["-m", "pytest"]:
            assert all((root / name).is_file() for name in rest[2:]), rest
        else:
            monkeypatch.setattr(sys, "argv", rest[rest[0] == "-m" :])
            with pytest.raises(Parsed):
                start(program, rest, root)

    return run


def start(program, rest, root):
    """Start a command, as a shell would; ``sys.argv`` has its name and its options."""
    if program == "svu":
        main(rest)
    elif rest[0] == "-m":
        runpy.run_module(rest[1], run_name="__main__", alter_sys=True)
    else:
        runpy.run_path(str(root / rest[0]), run_name="__main__")


def test_every_section_with_a_table_has_commands_and_their_time(root):
    found = sections(root)
    assert len(found) > 15
    for title, text in found.items():
        if TABLE.search(text):
            assert commands(text), f"{title}: no command"
        for line in commands(text):
            assert TIME.search(line), f"{title}: {line}: how long?"


def test_every_command_can_be_given(root, parse):
    for text in sections(root).values():
        for line in commands(text):
            parse(line)


@pytest.mark.parametrize(
    "line",
    ["svu bench accuracy --objekt vase", "svu benches", "make tests",
     "python -m pytest tests/test_none.py", "python tests/records/table2.py --texels 3",
     "PYTHONPATH=tests python -m studies.paths --texels 3"],
)  # fmt: skip
def test_a_wrong_command_is_noticed(line, parse, capsys):
    with pytest.raises((SystemExit, AssertionError, pytest.fail.Exception)):
        parse(line)


def test_records_keep_what_is_finished(root, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(root / "tests" / "records")
    record, measured = import_module("record"), []

    def judge(cell, work):
        measured.append(cell.name)
        return {"letters": len(cell.name)}

    cells = own_cells(["vase", "knot"], ["window"])
    asked = argparse.Namespace(work=tmp_path, only="vase")
    assert record.run("words", cells, asked, record.alone(judge, asked)) == {
        "vase__window": {"letters": 12}
    }
    asked.only = ""
    rows = record.run("words", cells, asked, record.alone(judge, asked))
    assert list(rows) == ["vase__window", "knot__window"] == measured
    two = record.run("two", cells[:1], asked, lambda _: lambda row: {"row": row}, ("a", "b"))
    assert two == {"vase__window": {"a": {"row": "a"}, "b": {"row": "b"}}}


@pytest.mark.slow
def test_figures_of_calibration_are_those_of_draws(root, vase, monkeypatch):
    monkeypatch.syspath_prepend(root / "tests" / "records")
    calibration, posterior = import_module("calibration"), vase.estimate.posterior
    chosen = np.flatnonzero(np.array(vase.estimate.coverage))[::5]
    known = ground_truth(vase.capture, vase.texels)
    truth = {name: known[name][chosen] for name in calibration.NAMES}
    found = calibration.figures(posterior, truth, chosen)
    assert all(np.isfinite(value) for value in found.values())
    assert all(0 <= found[key] <= 1 for key in found if key.startswith(("90", "50", "interval")))
    drawn = {name: np.array(x) for name, x in posterior.draw(64, seed=1).items()}
    for name in calibration.NAMES:
        own = drawn[name][:, chosen].reshape(64, len(chosen), -1).astype(np.float64)
        true = truth[name].reshape(len(chosen), -1)
        apart = np.abs(own[:, None] - own[None]).sum(axis=(0, 1)) / (64 * 63)
        crps = (np.abs(own - true).mean(axis=0) - apart / 2).mean()
        assert found[f"crps {name.replace('base_', '')[0]}"] == pytest.approx(crps, abs=0.005)


def test_every_benchmark_has_a_study():
    for name in BENCHMARKS:
        assert import_module(f"svu_mi.bench.{name}").STUDY.title
