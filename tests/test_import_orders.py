"""Whatever is imported first, a user's render and ours run, or ``import svu_mi`` says why not.

On a machine whose newest LLVM is 15 or 16, which Dr.Jit takes if nobody tells it otherwise.
"""

from __future__ import annotations

import _ctypes
import itertools
from pathlib import Path

import pytest
from helpers import python

from svu_mi import _llvm

# A user has not set the variable, which svu_mi has set for this process.
CLEAN = f"import os; os.environ.pop({_llvm.VARIABLE!r}, None)\n"
VARIANT = "import mitsuba as mi; mi.set_variant('llvm_ad_rgb')"
ORDERS = [
    "; ".join(order).replace("import mitsuba as mi", mitsuba)
    for mitsuba in ("import mitsuba as mi", VARIANT)
    for order in itertools.permutations(
        ("import drjit as dr", "import mitsuba as mi", "import svu_mi as svu")
    )
]
WORK = """
import sys, numpy as np
if mi.variant() is None:
    mi.set_variant("llvm_ad_rgb")
scene = mi.load_dict(mi.cornell_box())
keys = [key for key in mi.traverse(scene).keys() if "reflectance" in key]
parameters = mi.traverse(scene)
dr.enable_grad(parameters[keys[0]])
parameters.update()
image = mi.render(scene, parameters, spp=2)
dr.backward(dr.mean(image, axis=None))
assert np.array(dr.grad(parameters[keys[0]])).any()
capture = svu.load_capture(sys.argv[1])
found = svu.estimate(capture, svu.texels(capture.mesh, (24, 24)))
print(dr.detail.llvm_version()[0], np.array(image).mean(), found.entropy.numpy().mean())
"""
ALIVE = (
    "svu_mi.errors.SvuEnvironmentError: Dr.Jit has loaded LLVM {}, which aborts the process on "
    "x86-64, and something made with it is alive: restart Python (the kernel), and import svu_mi "
    "before the first scene is loaded."
)


@pytest.fixture(scope="module")
def bad() -> str:
    """Version of the LLVM that Dr.Jit takes here by itself, if that is one of those that abort."""
    code = "import drjit as dr; print(*dr.detail.llvm_version(), sep='.')"
    found = python("-c", CLEAN + code).stdout.strip()
    if not _llvm.is_x86() or found.partition(".")[0] not in ("15", "16"):
        pytest.skip(f"Dr.Jit finds LLVM {found} by itself, which does not abort")
    return found


def run(code: str, *words: object):
    """Run a user's program in a fresh process."""
    return python("-c", CLEAN + code, *words)


@pytest.mark.few(1)
@pytest.mark.parametrize("order", ORDERS)
def test_all_orders_of_import_render_and_estimate(order, bad, shot):
    done = run(order + WORK, shot)
    assert done.returncode == 0, done.stderr
    version, image, entropy = map(float, done.stdout.split())
    assert version >= _llvm.FIRST_GOOD_X86
    assert 0.1 < image < 1 and 0.1 < entropy < 1


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "made",
    [
        f"{VARIANT}; kept = mi.load_dict({{'type': 'null'}})",
        f"{VARIANT}; kept = mi.load_dict(mi.cornell_box())",
        "from drjit.llvm import Float; kept = Float(1, 2)",
    ],
    ids=["object without arrays", "scene", "array"],
)
def test_what_lives_is_told_at_import_and_may_be_given_up(made, bad):
    retry = f"""
import sys
{made}
try:
    import svu_mi
except Exception as error:
    assert "svu_mi" not in sys.modules
    print(f"{{type(error).__module__}}.{{type(error).__name__}}: {{error}}")
del kept
import svu_mi, drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()
print(dr.detail.llvm_version()[0] >= {_llvm.FIRST_GOOD_X86})
"""
    done = run(retry)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [ALIVE.format(bad), "True"]


def test_a_scalar_scene_is_none_of_its_business(bad):
    code = """
import mitsuba as mi
mi.set_variant("scalar_rgb")
scene = mi.load_dict(mi.cornell_box())
import svu_mi, drjit as dr
image = mi.render(scene, spp=1)
mi.set_variant("llvm_ad_rgb")
mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()
print(dr.detail.llvm_version()[0])
"""
    done = run(code)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= _llvm.FIRST_GOOD_X86


def test_a_variable_set_after_mitsuba_is_followed(bad):
    """Dr.Jit alone does not look at it again."""
    library = _llvm.first_usable(_llvm.find_candidates()).path
    code = f"""
import mitsuba as mi, os
os.environ["{_llvm.VARIABLE}"] = {library!r}
import svu_mi, drjit as dr
print(dr.detail.llvm_version()[0], svu_mi._llvm.status().source)
"""
    version, source = run(code).stdout.split()
    assert int(version) >= _llvm.FIRST_GOOD_X86 and source == "user"


@pytest.mark.few(2)
@pytest.mark.parametrize("variant", ["", VARIANT], ids=["", "variant set"])
@pytest.mark.parametrize(
    ("content", "says"),
    [(b"", "file too short"), (Path(_ctypes.__file__).read_bytes(), "undefined symbol: LLVMGet")],
    ids=["empty", "of something else"],
)
def test_a_library_that_is_none_is_told_and_all_is_left_as_it_was(
    variant, content, says, bad, tmp_path
):
    """Its name promises LLVM 19."""
    library = tmp_path / "libLLVM.so.19.1"
    library.write_bytes(content)
    code = f"""
import os, drjit as dr, mitsuba as mi
{variant}
os.environ["{_llvm.VARIABLE}"] = {str(library)!r}
try:
    from svu_mi import _llvm
    _llvm.require()
except Exception as error:
    print(error)
mi.set_variant("llvm_ad_rgb")
print(dr.detail.llvm_version()[0], mi.xyz_to_srgb(mi.cie1931_xyz(mi.Float(500.))).x[0] < -0.6)
"""
    done = run(code)
    assert done.returncode == 0, done.stderr
    told, works = done.stdout.splitlines()
    assert told.startswith(f"Dr.Jit has loaded LLVM {bad}, which aborts the process on x86-64. ")
    assert f"{library} cannot be loaded" in told and says in told
    assert works == f"{bad.partition('.')[0]} True"
