"""Fixtures for all tests. svu_mi comes first: it chooses LLVM before Dr.Jit is imported."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from support import quick_kernels, repeated_work
from support.browser import Browser

import svu_mi  # noqa: F401

ROOT = Path(__file__).parent.parent
VARIANT = os.environ.get("SVU_TEST_VARIANT", "llvm_ad_rgb")  # cuda_ad_rgb: all of it on a GPU
LONGEST = "tests/test_docs", "tests/test_notebooks", "tests/test_pipeline"
# Read when Dr.Jit is first imported: compiled kernels are kept with the checkout, not in HOME.
os.environ.setdefault("DRJIT_CACHE_DIR", str(ROOT / ".pytest_cache" / "drjit"))
# Read when NumPy is first imported, which for the workers of -n is later than this: its threads
# spin while they wait, on cores that the other worker needs.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
quick_kernels.use()
sys.dont_write_bytecode = False  # to rewrite the assertions of all tests takes 8 s


@pytest.hookimpl(tryfirst=True)  # before -m is looked at
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all but some cases of a test slow where it asks for that (``few``); sort files.

    A file is one worker's, so those that take longest go first: at the end, others would wait.
    """
    items.sort(key=lambda item: not item.nodeid.startswith(LONGEST))
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        if VARIANT.startswith("cuda") and item.get_closest_marker("forks"):
            item.add_marker(pytest.mark.skip("CUDA does not survive a fork"))
        if item.get_closest_marker("few"):
            cases.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for several in cases.values():
        count = several[0].get_closest_marker("few").args[0]
        kept = {len(several) * place // count for place in range(count)}
        for number, item in enumerate(several):
            if number not in kept:
                item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session", autouse=True)
def _variant_is_set() -> None:
    import mitsuba as mi

    mi.set_variant(VARIANT)

    from svu_mi.capture.scene import require_variant

    require_variant()  # as every function for users: exact division on CUDA
    repeated_work.remember()


@pytest.fixture
def variant() -> Iterator[str]:
    """Name of the active variant; a test that changes it finds it restored afterwards.

    So is how much Mitsuba logs, which ``svu`` changes, too.
    """
    import mitsuba as mi

    yield VARIANT
    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Warn)


@pytest.fixture(scope="session")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture folder rendered by ``svu``: the vase, 8 views placed on a sphere. Read only."""
    from support.helpers import run

    from svu_mi import scenes

    folder = tmp_path_factory.mktemp("shot")
    words = ("render", scenes.path("vase"), "-D", "light=window", "--views", 8)
    assert run(*words, "--resolution", 40, 32, "--spp", 4, "-o", folder) == 0
    return folder


@pytest.fixture(scope="session")
def vase() -> SimpleNamespace:
    """A small capture of the vase, its texels, and what its photographs say. Read only."""
    import svu_mi as svu
    from svu_mi import scenes

    capture = svu.render_capture(
        scenes.path("vase"), spp=8, views=4, resolution=(48, 36), defines={"light": "window"}
    )
    texels = svu.texels(capture.mesh, (64, 48))
    estimate = svu.estimate(capture, texels)
    return SimpleNamespace(capture=capture, texels=texels, estimate=estimate)


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A headless Chromium; without one on PATH the test is skipped."""
    running = Browser(tmp_path_factory.mktemp("browser"))
    yield running
    running.close()
