"""``svu doctor``: a healthy machine, an abort in the render test, and the exit status."""

from __future__ import annotations

import io
import os

import drjit as dr
import mitsuba as mi
import pytest
from rich.console import Console

from svu_mi import _llvm
from svu_mi.cli import doctor
from svu_mi.errors import OutputError


@pytest.fixture(scope="module")
def diagnosis():
    return doctor.diagnose()


def printed(diagnosis):
    console = Console(file=io.StringIO(), width=200)
    doctor.show(*diagnosis, console)
    return console.file.getvalue()


def test_this_machine_is_healthy(diagnosis):
    """If this fails, so do all other tests; the message is from the doctor."""
    facts, checks = diagnosis
    assert all(check.ok for check in checks), printed(diagnosis)
    names = {check.name for check in checks}
    assert {"mitsuba", "OpenEXR", "render with llvm_ad_rgb"} <= names
    assert facts["Variants"] == ", ".join(mi.variants())
    assert {"scalar_rgb", "llvm_ad_rgb"} <= set(facts["Usable"].split(", "))
    assert facts["LLVM"].startswith(_llvm.dotted(dr.detail.llvm_version()))
    text = printed(diagnosis)
    for words in ("Python", f"mitsuba {mi.__version__}", "CUDA", "OptiX", "Metal", "Threads",
                  "Kernel cache", "expected 1"):  # fmt: skip
        assert words in text


def test_exit_status_tells_health(monkeypatch, diagnosis):
    console = Console(file=io.StringIO())
    monkeypatch.setattr(doctor, "diagnose", lambda: diagnosis)
    assert doctor.Doctor().run(console) == 0
    sick = doctor.HealthCheck("OpenEXR", False, "it differs", "reinstall it")
    monkeypatch.setattr(doctor, "diagnose", lambda: (diagnosis[0], [*diagnosis[1], sick]))
    assert doctor.Doctor().run(console) == 2
    assert "Remedy for OpenEXR: reinstall it" in console.file.getvalue()


def test_an_abort_of_the_render_test_is_reported(monkeypatch):
    """Abort like LLVM 15: a line on stderr, then SIGABRT."""
    child = "import os, sys; sys.stderr.write('Cannot select: fminimum\\n'); os.abort()  # {}"
    monkeypatch.setattr(doctor, "CHILD", child)
    check = doctor.check_render("llvm_ad_rgb")
    assert not check.ok
    if os.name == "posix":
        assert "SIGABRT" in check.detail
        assert "Cannot select: fminimum" in check.detail
    assert _llvm.remedy() in check.remedy


def test_an_abort_while_loading_mitsuba_is_reported(monkeypatch):
    monkeypatch.setattr(doctor, "CHILD", "import os; os.abort()  # {}")
    diagnosis = doctor.diagnose()
    assert diagnosis[0]["Usable"] == "none"
    assert [check.name for check in diagnosis[1] if not check.ok] == ["mitsuba", "render"]
    assert "unknown" in printed(diagnosis)


def test_a_test_that_hangs_is_reported(monkeypatch):
    monkeypatch.setattr(doctor, "CHILD", "import time; time.sleep(60)  # {}")
    monkeypatch.setattr(doctor, "TIMEOUT_S", 0.2)
    assert "no answer" in doctor.check_render("llvm_ad_rgb").detail


def test_unusable_llvm_is_named_with_its_remedy():
    status = _llvm.LlvmStatus(None, (15,), "none", "LLVM 15 aborts; run 'pip install ...'.")
    (check,) = doctor.check_renders(["scalar_rgb"], status)
    assert not check.ok and check.remedy == status.problem


def test_missing_package_is_named():
    check = doctor.check_packages({"mitsuba": "3.9.1", "xatlas": "missing"})
    assert not check.ok and "xatlas" in check.detail and "mitsuba" not in check.detail


def test_exr_that_reads_back_differently_is_reported(monkeypatch):
    import svu_mi.core.io.exr

    def refuse(*_):
        raise OutputError("channel Y differs")

    monkeypatch.setattr(svu_mi.core.io.exr, "write_exr", refuse)
    assert not doctor.check_exr().ok
