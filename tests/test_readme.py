"""Commands, Python code and file names in README, pages and CONTRIBUTING are valid."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "notebooks").glob("*.md"))]


HOW = "notebooks/how.md"


def script(page: str, heading: str) -> str:
    """Return the code block of a section."""
    text = (ROOT / page).read_text(encoding="utf-8") + "\n## "
    section = re.search(rf"^## {heading}\n(.*?)^## ", text, re.M | re.S)
    assert section is not None
    blocks = re.findall(r"^```python\n(.*?)^```", section[1], re.M | re.S)
    assert len(blocks) == 1
    return blocks[0]


def commands(page: Path) -> list[list[str]]:
    """Return the words of each command of svu that stands on a line of its own."""
    lines = re.findall(r"^    svu (.*)$", page.read_text(encoding="utf-8"), re.M)
    return [shlex.split(line, comments=True) for line in lines]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_are_understood(page, capsys):
    from svu_mi.cli.main import parse

    for words in commands(page):
        try:
            parse(*words)
        except SystemExit as stop:
            pytest.fail(f"svu {shlex.join(words)}: {stop.code} {capsys.readouterr()}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_python_names_exist(page):
    import svu_mi

    text = page.read_text(encoding="utf-8")
    assert set(re.findall(r"\bsvu\.([A-Za-z_]+)", text)) <= set(svu_mi.__all__)


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", HOW])
def test_pages_name_files_that_exist(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:svu_mi|tests|plugins|notebooks)/[\w./]+)`", text))
    missing = [name for name in named if "NAME" not in name and not (ROOT / name).exists()]
    for name in re.findall(r"`(\w+\.py)`", text):  # of the folder that was named before
        missing += [] if list((ROOT / "svu_mi").rglob(name)) else [name]
    assert not missing


def test_the_way_of_a_pixel_names_functions_that_exist():
    rows = re.findall(r"\| `(svu_mi/[\w/]+[.]py)` \| `(\w+)` \|", (ROOT / HOW).read_text())
    assert len(rows) > 20
    missing = [row for row in rows if f"def {row[1]}(" not in (ROOT / row[0]).read_text()]
    assert not missing


def test_guarantees_name_tests_that_exist():
    page = (ROOT / "notebooks" / "promises.md").read_text(encoding="utf-8")
    files = (path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    existing = {name for text in files for name in re.findall(r"def (test_\w+)", text)}
    assert set(re.findall(r"`(test_\w+)`", page)) <= existing


@pytest.mark.slow
def test_the_script_of_the_readme_runs(tmp_path, monkeypatch):
    from svu_mi.cli.main import main

    monkeypatch.chdir(tmp_path)
    scene = ROOT / "scenes" / "vase" / "vase.xml"
    small = ("-D", "resolution=64", "--spp", "8")
    assert main(["render", str(scene), "-D", "light=window", *small, "-o", "capture"]) == 0
    names: dict[str, Any] = {}
    code = script("README.md", "From Python").replace("256", "64").replace("100", "20")
    exec(compile(code, "README.md", "exec"), names)
    assert names["entropy"].shape == names["sd"].shape == names["roughness"].shape == (64, 64)
    assert (np.array(names["low"]) <= np.array(names["high"])).all()
    assert len(names["views"].proposals) == 5
