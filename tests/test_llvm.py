"""The choice of the LLVM library, and errors without a usable one."""

from __future__ import annotations

import json
import os
import sys

import pytest
from support.helpers import python

from svu_mi import _llvm
from svu_mi.errors import SvuEnvironmentError

FAKE = "libLLVM.so.{}"


@pytest.fixture
def machine(monkeypatch):
    """An x86-64 machine where nothing has been chosen yet."""
    monkeypatch.setenv(_llvm.VARIABLE, "")  # so that monkeypatch restores it
    monkeypatch.setattr(_llvm, "is_x86", lambda: True)
    monkeypatch.setattr(_llvm, "_status", None)
    return monkeypatch


def library(folder, version):
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / FAKE.format(version)
    path.write_bytes(b"")
    return str(path)


def run_python(code, **environment):
    """Run a program in a fresh interpreter and return what it printed as JSON."""
    unset = f"import os; os.environ.pop({_llvm.VARIABLE!r})\n"  # of the tests' own process
    done = python("-c", code if environment else unset + code, **environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


# --- the gate -----------------------------------------------------------------------------


def pretend_loaded(monkeypatch, version):
    import drjit as dr

    monkeypatch.setattr(dr.detail, "llvm_version", lambda: version)


@pytest.mark.parametrize("version", [(15, 0, 6), (16, 0, 6)])
def test_gate_refuses_versions_that_abort_on_x86(machine, version):
    machine.setattr(_llvm, "_status", _llvm.LlvmStatus("libLLVM.so", (19,), "system"))
    pretend_loaded(machine, version)
    with pytest.raises(SvuEnvironmentError, match=rf"LLVM {version[0]}.*aborts .* x86-64"):
        _llvm.require()


@pytest.mark.parametrize(("x86", "version"), [(False, (15, 0, 6)), (True, (17, 0, 6))])
def test_gate_accepts_libraries_that_do_not_abort(machine, x86, version):
    machine.setattr(_llvm, "is_x86", lambda: x86)
    pretend_loaded(machine, version)
    _llvm.require()
    assert _llvm.status().version == version


def test_gate_reports_why_a_chosen_library_failed(machine, tmp_path):
    broken = library(tmp_path, "19.1")
    machine.setattr(_llvm, "_status", _llvm.LlvmStatus(broken, (19, 1), "system"))
    pretend_loaded(machine, (-1, -1, -1))
    with pytest.raises(SvuEnvironmentError, match=r"could not load.*19\.1.*file too short"):
        _llvm.require()


@pytest.mark.parametrize(
    ("platform", "words"),
    [("linux", "apt install"), ("darwin", "brew install llvm"), ("win32", "LLVM-C.dll")],
)
def test_remedy_fits_the_operating_system(monkeypatch, platform, words):
    monkeypatch.setattr(sys, "platform", platform)
    assert words in _llvm.remedy()


# --- the user's own choice ----------------------------------------------------------------


def chosen_for(machine, given):
    machine.setenv(_llvm.VARIABLE, str(given))
    return _llvm.choose([("system", "libLLVM.so.19.1")])


def test_users_library_wins(machine, tmp_path):
    mine = library(tmp_path, "18.1")
    choice = chosen_for(machine, mine)
    assert (choice.path, choice.version, choice.source) == (mine, (18, 1), "user")
    assert choice.problem is None


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (".", "is a folder; set it to the library file"), ("no.so", "does not exist; set it to"),
        ("text.so", "is not an LLVM library"),
    ],
)  # fmt: skip
def test_invalid_library_is_refused_with_the_remedy(machine, tmp_path, name, words):
    (tmp_path / "text.so").write_text("not a library")
    assert words in (chosen_for(machine, tmp_path / name).problem or "")


def test_users_llvm_15_is_refused_and_hidden_from_dr_jit(machine, tmp_path):
    """Without us calling require(), Dr.Jit must not load it either: it would abort."""
    mine = library(tmp_path, "15.0")
    assert "aborts the process" in (chosen_for(machine, mine).problem or "")
    assert os.environ[_llvm.VARIABLE] == _llvm.REFUSED + mine
    again = _llvm.choose([])  # a child process inherits the variable, and says the same
    assert again.problem and mine in again.problem
    assert os.environ[_llvm.VARIABLE] == _llvm.REFUSED + mine


def test_require_raises_the_problem_of_bootstrap(machine, tmp_path):
    machine.setenv(_llvm.VARIABLE, str(tmp_path))
    machine.setattr(_llvm, "_status", _llvm.choose())
    with pytest.raises(SvuEnvironmentError, match="is a folder"):
        _llvm.require()


# --- the search ---------------------------------------------------------------------------


def test_first_usable_candidate_is_taken_and_dr_jit_is_told(machine):
    candidates = [("system", "/a/libLLVM-14.so.1"), ("system", "/a/libLLVM-16.so.1"),
                  ("conda", "/b/libLLVM-17.so"), ("wheel", "/c/libLLVM.so.23.1")]  # fmt: skip
    choice = _llvm.choose(candidates)
    assert (choice.path, choice.source, choice.version) == ("/b/libLLVM-17.so", "conda", (17,))
    assert os.environ[_llvm.VARIABLE] == "/b/libLLVM-17.so"


def test_only_bad_libraries_means_none_for_dr_jit_too(machine):
    choice = _llvm.choose([("system", "/a/libLLVM-15.so.1"), ("system", "/a/libLLVM-14.so.1")])
    assert choice.path is None
    assert "/a/libLLVM-15.so.1 is LLVM 15" in (choice.problem or "")
    assert os.environ[_llvm.VARIABLE] == _llvm.REFUSED


def test_no_library_at_all_leaves_the_variable_alone(machine):
    machine.setattr(_llvm, "find_candidates", lambda: iter(()))
    assert "No LLVM library was found" in (_llvm.choose().problem or "")
    assert os.environ[_llvm.VARIABLE] == ""


def test_newest_library_of_a_folder_comes_first(tmp_path):
    for name in ("libLLVM-9.so", "libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVMSPIRVLib.so.19.1",
                 "libLLVM.so.20.1-rust-1.88.0-stable", "libLLVM.so"):  # fmt: skip
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    names = [os.path.basename(path) for _, path in _llvm.newest_first("x", [str(tmp_path)])]
    assert names == ["libLLVM.so.19.1", "libLLVM-15.so.1", "libLLVM-9.so", "libLLVM.so"]


def test_wheel_is_found_where_its_record_says(machine, tmp_path):
    """As after ``pip install --user``: two folders above site-packages, not in sys.prefix."""
    site = tmp_path / "lib" / "python3.11" / "site-packages"
    info = site / "karellen_llvm_core-23.1.4.post8.dist-info"
    info.mkdir(parents=True)
    (info / "RECORD").write_text("../../libLLVM.so.23.1,sha256=0,1\nother.py,,\n")
    mine = library(tmp_path / "lib", "23.1")
    machine.setattr(sys, "path", [str(tmp_path / "absent"), str(site)])
    assert _llvm.newest_first("wheel", _llvm._wheel_folders()) == [("wheel", mine)]


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/libLLVM-15.so.1", (15,)),
        ("/usr/lib/libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("/usr/lib/libLLVM.so.19.1", (19, 1)),
        ("/opt/homebrew/Cellar/llvm@19/19.1.7/lib/libLLVM.dylib", (19, 1, 7)),
        ("/conda/lib/libLLVM.18.1.dylib", (18, 1)),
        ("/usr/lib/libLLVM.so", ()),
        ("C:/LLVM/bin/LLVM-C.dll", ()),
    ],
)
def test_versions_that_paths_state(path, version):
    assert _llvm.stated_version(path) == version


def test_library_without_version_in_name_is_queried():
    """The one that Dr.Jit uses now knows its version as well as its name does."""
    used = os.environ[_llvm.VARIABLE]
    stated = _llvm.stated_version(os.path.realpath(used))
    assert _llvm._queried_version(used)[: len(stated)] == stated


# --- in fresh processes -------------------------------------------------------------------

REPORT = """
import json, os
from svu_mi import _llvm
import drjit as dr
status = _llvm.status()
print(json.dumps([os.environ.get(_llvm.VARIABLE), status.problem, dr.detail.llvm_version()[0]]))
"""


def test_import_points_dr_jit_to_a_good_library():
    path, problem, version = run_python("import svu_mi" + REPORT)
    assert os.path.isfile(path) and problem is None and version >= 17


def test_users_folder_does_not_break_the_import(tmp_path):
    _, problem, version = run_python("import svu_mi" + REPORT, **{_llvm.VARIABLE: str(tmp_path)})
    assert "is a folder" in problem and version == -1


def test_wheel_without_its_links_is_loaded_all_the_same(tmp_path):
    """The state after pip until the interpreter's next start, and for ever if read-only."""
    wheel = dict(_llvm.newest_first("wheel", [os.path.join(sys.prefix, "lib")])).get("wheel")
    if wheel is None:
        pytest.skip("the wheel is not installed in this environment")
    folder = "x86_64-unknown-linux-gnu"
    (tmp_path / folder).mkdir()
    (tmp_path / os.path.basename(wheel)).symlink_to(wheel)
    for name in _llvm.RUNTIME:
        source = os.path.join(os.path.dirname(wheel), folder, name)
        (tmp_path / folder / name).symlink_to(source)
    mine = str(tmp_path / os.path.basename(wheel))
    path, problem, version = run_python("import svu_mi" + REPORT, **{_llvm.VARIABLE: mine})
    assert (path, problem) == (mine, None) and version >= 17
