"""Fixtures for all tests. svu_mi comes first: it chooses LLVM before Dr.Jit is imported."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

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
    from helpers import run

    from svu_mi import scenes

    folder = tmp_path_factory.mktemp("shot")
    words = ("render", scenes.path("vase"), "-D", "light=window", "--views", 8)
    assert run(*words, "--resolution", 40, 32, "--spp", 4, "-o", folder) == 0
    return folder


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT
