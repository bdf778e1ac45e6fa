"""Fixtures for all tests. svu_mi comes first: it chooses LLVM before Dr.Jit is imported."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import Browser

import svu_mi  # noqa: F401

ROOT = Path(__file__).parent.parent
VARIANT = "llvm_ad_rgb"
# Read when Dr.Jit is first imported: compiled kernels are kept with the checkout, not in HOME.
os.environ.setdefault("DRJIT_CACHE_DIR", str(ROOT / ".pytest_cache" / "drjit"))


@pytest.fixture(scope="session", autouse=True)
def _variant_is_set() -> None:
    import mitsuba as mi

    mi.set_variant(VARIANT)


@pytest.fixture
def variant() -> Iterator[str]:
    """Name of the active variant; a test that changes it finds it restored afterwards."""
    import mitsuba as mi

    yield VARIANT
    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)


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
