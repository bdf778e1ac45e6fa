"""BENCHMARKS.md and notebooks/benchmarks/*.md contain the figures of the stored records."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

from svu_mi.bench import BENCHMARKS
from svu_mi.bench.markdown import Bar


@pytest.fixture(scope="module")
def script(root):
    return runpy.run_path(str(root / "notebooks" / "write_benchmarks.py"))


@pytest.fixture(scope="module")
def records(script):
    return script["read_all"]()


def test_pages_are_written_from_the_records(script, records, root):
    pages = script["texts"](records)
    for path, text in pages.items():
        assert path.read_text() == text, f"{path}: run python notebooks/write_benchmarks.py"
    assert set(pages) == {root / "BENCHMARKS.md", *script["FOLDER"].glob("*.md")}


def test_the_overview_is_short_and_has_every_study(script, records, root):
    text = (root / "BENCHMARKS.md").read_text()
    assert len(text.splitlines()) <= 150
    sections = [section.rows for section in script["SECTIONS"]]
    assert set().union(*sections) == set(BENCHMARKS)
    assert "not measured" in script["overview"]({})
    for name in set(BENCHMARKS) - set(records):
        assert f"`svu bench {name}`: not measured." in text


def test_records_are_of_one_version_or_named(records, root):
    text = (root / "BENCHMARKS.md").read_text()
    codes = {", ".join(record["code"]) for record in records.values()}
    for code in codes:
        names = [name for name, record in records.items() if ", ".join(record["code"]) == code]
        assert len(codes) == 1 or f"Code {code}: {', '.join(names)}." in text
    assert ("one version of the code" in text) == (len(codes) == 1)


def test_records_name_no_folder_of_a_machine(script):
    for path in script["FOLDER"].glob("*.json"):
        text = path.read_text()
        assert str(Path.home()) not in text and "/tmp/" not in text, path
        assert json.loads(text)["study"] == path.stem


def test_records_are_copied_with_fewer_digits(script, tmp_path, monkeypatch):
    source, target = tmp_path / "out", tmp_path / "benchmarks"
    source.mkdir(), target.mkdir()
    entropy = [k / 3 for k in range(100)]
    cell = {"cell": "vase / window", "seconds": 1 / 3, "entropy": entropy, "curve": entropy}
    record = {"study": "speed", "cells": [cell], "bars": [], "code": ["a"]}
    (source / "speed.json").write_text(json.dumps(record, indent=2))
    monkeypatch.setitem(script["copy"].__globals__, "FOLDER", target)
    script["copy"](source)
    (path,) = target.iterdir()
    copied = json.loads(path.read_text())
    assert copied.keys() == {"study", "cells", "code"} and len(path.read_text().splitlines()) == 1
    (case,) = copied["cells"]
    assert case["seconds"] == 0.333333 and case["curve"][1] == 0.333 and len(case["curve"]) == 100
    assert case["entropy"] == pytest.approx(entropy[::4], rel=5e-3)  # scatter plots


def test_bars_of_a_row_are_joined(script):
    names = {"a: mean": 0.9, "a: worst": 0.5, "b": 1.0}
    found = {"bars": [Bar(name, value, 0.7, least=True).record() for name, value in names.items()]}
    rows = script["bars"](found, {"a: mean / worst": ["a: "], "b": ["b"], "c": ["c"]})
    assert rows == [["a: mean / worst", "0.9 / 0.5", ">= 0.7, **missed**"], ["b", "1", ">= 0.7"]]
