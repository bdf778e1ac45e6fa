"""Dr.Jit imported before svu_mi, on a machine whose newest LLVM is 15 or 16."""

from __future__ import annotations

import pytest
from support.helpers import python

from svu_mi import _llvm

# A user has not set the variable, which svu_mi has set for this process.
CLEAN = f"import os; os.environ.pop({_llvm.VARIABLE!r}, None)\n"
TRIED = """
import {first}
{then}
try:
    import svu_mi as svu
    svu._llvm.require()
except Exception as error:
    print(f"{{type(error).__module__}}.{{type(error).__name__}}: {{error}}")
print("svu_mi" in sys.modules)
"""


@pytest.fixture(scope="module")
def bad() -> str:
    """Version of the LLVM that Dr.Jit takes here by itself, if that is one of those that abort."""
    code = "import drjit as dr; print(*dr.detail.llvm_version(), sep='.')"
    version = python("-c", CLEAN + code).stdout.strip()
    if not _llvm.is_x86() or version.partition(".")[0] not in ("15", "16"):
        pytest.skip(f"Dr.Jit finds LLVM {version} by itself, which does not abort")
    return version


@pytest.mark.parametrize(("first", "variant", "imported"), [
    ("drjit", "", True),
    ("mitsuba", "mitsuba.set_variant('scalar_rgb')", True),
    ("mitsuba", "mitsuba.set_variant('llvm_ad_rgb')", False),
])  # fmt: skip
def test_a_library_that_aborts_is_refused_when_it_is_used(bad, first, variant, imported):
    """By ``import svu_mi`` if an LLVM variant is set, else when one is about to be used."""
    done = python("-c", CLEAN + "import sys" + TRIED.format(first=first, then=variant))
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        f"svu_mi.errors.SvuEnvironmentError: Dr.Jit has loaded LLVM {bad}, which aborts the "
        "process on x86-64: restart Python (the kernel), and import svu_mi before drjit and "
        "mitsuba.",
        str(imported),
    ]


def test_a_good_library_is_used_after_dr_jit():
    code = (
        "import mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n"
        "import svu_mi as svu; svu._llvm.require(); print(svu._llvm.status().problem)"
    )
    assert python("-c", code).stdout == "None\n"  # which the variable of this process names
