"""The documentation builds without a warning, and everything public is in it."""

from __future__ import annotations

import html
import os
import re
import subprocess
import sys

import pytest

pytest.importorskip("myst_nb", reason="the extra docs is not installed")
pytestmark = pytest.mark.slow


def sphinx(root, folder, *words):
    """Run Sphinx as ``make docs`` does, and return what it prints."""
    run = subprocess.run(
        [sys.executable, "-m", "support.quick_kernels", "sphinx", *words,
         "--quiet", "--conf-dir", "notebooks", ".", folder],
        cwd=root, env={**os.environ, "PYTHONPATH": str(root / "tests")}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0 and not run.stderr, run.stderr
    return run.stdout


@pytest.fixture(scope="module")
def build(root, tmp_path_factory):
    """Folder of the built pages."""
    folder = tmp_path_factory.mktemp("docs")
    sphinx(root, folder, "--fail-on-warning", "--keep-going")
    return folder


@pytest.fixture(scope="module")
def pages(build):
    """Text of every page, by its name."""
    return {
        path.relative_to(build).with_suffix("").as_posix(): path.read_text(encoding="utf-8")
        for path in build.rglob("*.html")
    }


def headings(page: str) -> list[str]:
    """Return the headings of a page, without tags and link marks."""
    heads = re.findall(r"<h\d>(.*?)</h\d>", page, re.S)
    return [html.unescape(re.sub(r"<a class=.*|<[^>]+>", "", text)) for text in heads]


def test_every_public_name_is_documented(pages):
    import svu_mi

    documented = set(re.findall(r'id="svu_mi\.([\w.]+)"', pages["notebooks/python"]))
    assert set(svu_mi.__all__) <= documented
    assert {"Posterior.entropy", "Estimate.image", "Preset.degree"} <= documented  # members, too


def test_examples_of_the_reference_run(root, build, tmp_path):
    sphinx(root, tmp_path, "--builder", "doctest", "--doctree-dir", build / ".doctrees")
    results = (tmp_path / "output.txt").read_text(encoding="utf-8")
    assert int(re.search(r"(\d+) tests?\n", results)[1]) > 100
    assert "    0 failures in tests" in results


def test_every_public_name_has_an_example():
    import svu_mi

    need_weights = {"DiffusionOptions", "fill_by_diffusion"}
    docs = {name: getattr(svu_mi, name).__doc__ for name in svu_mi.__all__}
    assert {name for name, doc in docs.items() if ">>>" not in doc} <= need_weights


def test_every_command_is_documented(pages):
    from svu_mi.cli.main import COMMANDS

    page = pages["notebooks/commands"]
    for name in COMMANDS:
        assert f"svu {name}" in headings(page) and f"usage: svu {name} " in page, name


def test_every_plugin_is_documented(pages):
    from svu_mi.plugins import registry

    page = pages["notebooks/plugins"]
    for name in registry.MODULES:
        assert any(f"({name})" in heading for heading in headings(page)), name
        assert f"svu_mi.plugins.{name}." in page


def test_every_page_and_notebook_is_there(pages, root):
    written = [*root.glob("*.md"), *(root / "notebooks").iterdir()]
    written = [path for path in written if path.suffix in (".md", ".rst", ".ipynb")]
    assert len(written) > 15
    for path in written:
        assert path.relative_to(root).with_suffix("").as_posix() in pages, path


def test_pages_need_no_network(pages):
    for name, page in pages.items():
        loaded = re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="(https?:[^"]*)"', page)
        assert not loaded, (name, loaded)


def test_windows_of_1280_pixels_have_navigation(build):
    """In narrower windows than this, the theme moves it below the page."""
    css = (build / "_static" / "alabaster.css").read_text(encoding="utf-8")
    assert int(re.search(r"media screen and \(max-width: (\d+)px\)", css)[1]) <= 1200
