"""BENCHMARKS.md and notebooks/benchmarks/*.md contain the figures of the stored records."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

from svu_mi.bench import BENCHMARKS


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
