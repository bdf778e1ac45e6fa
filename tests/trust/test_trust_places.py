"""Places to run from: foreign settings, a folder that is gone, a machine with one core."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import write_scene

from svu_mi import scenes

SECONDS = 120
SETTINGS = """backend: module://evil
figure.facecolor: red
text.usetex: True
axes.prop_cycle: cycler(color=["red"])
no such setting
"""
SHOW = """
import sys
from svu_mi.cli.pictures import import_matplotlib
import_matplotlib()
import matplotlib, os
from matplotlib import rcParams, rcParamsDefault
changed = {key for key in rcParams if rcParams._get(key) != rcParamsDefault._get(key)}
print(sorted(changed - {"backend", "backend_fallback"}))
print(type(rcParams._get("backend")) is str, os.getcwd(), os.environ.get("MPLBACKEND"))
"""


def python(*words: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, *words], cwd=cwd, env=os.environ | environment, capture_output=True,
        text=True, timeout=SECONDS,
    )  # fmt: skip


@pytest.mark.parametrize("end", [b"", b"font.size: \xff\xfe"], ids=["foreign", "no text"])
@pytest.mark.parametrize("backend", ["", "module://evil", "nonsense"])
def test_settings_of_the_working_directory_are_not_read(tmp_path, end, backend):
    """Unless ignored, bytes that are no text, and an unknown backend, are errors on import."""
    (tmp_path / "matplotlibrc").write_bytes(SETTINGS.encode() + end)
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')")
    done = python("-c", SHOW, cwd=tmp_path, MPLBACKEND=backend, MATPLOTLIBRC=str(tmp_path))
    assert done.stderr == ""
    assert done.stdout.splitlines() == ["[]", f"False {tmp_path} {backend or ''}"]


def test_every_command_imports_it_that_way():
    """Before anything of the command: no other import comes first."""
    code = (
        "import sys, svu_mi.cli.main as program\n"
        "assert 'matplotlib' not in sys.modules\n"
        "program.Doctor.run = lambda self, console: 'matplotlib' not in sys.modules\n"
        "sys.exit(program.main(['doctor']))"
    )
    assert python("-c", code, cwd=Path.cwd()).returncode == 0


def test_pictures_are_the_same_beside_foreign_settings(tmp_path):
    (tmp_path / "matplotlibrc").write_text(SETTINGS)
    code = (
        "import svu_mi.cli.main as program\n"
        "from svu_mi.output.style import new_figure, save_figure\n"
        "def run(self, console):\n"
        "    figure = new_figure(1, 1); figure.text(0, 0, 'a_b'); save_figure(figure, 'p.png')\n"
        "    return 0\n"
        "program.Doctor.run = run\n"
        "raise SystemExit(program.main(['doctor']))"
    )
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path, tmp_path / "empty"):
        assert python("-c", code, cwd=folder).returncode == 0
    assert (tmp_path / "p.png").read_bytes() == (tmp_path / "empty" / "p.png").read_bytes()


def test_an_imported_matplotlib_is_left_alone(tmp_path):
    code = (
        "import matplotlib; matplotlib.rcParams['font.size'] = 3\n"
        "from svu_mi.cli.pictures import import_matplotlib\n"
        "import_matplotlib(); assert matplotlib.rcParams['font.size'] == 3"
    )
    assert python("-c", code, cwd=tmp_path).returncode == 0


COMMANDS = ("entropy", "check", "guide", "recover", "report", "export", "import", "render", "view",
            "demo", "bench", "doctor")  # fmt: skip
GONE = "svu: The working directory cannot be used (No such file or directory); change to another"


@pytest.mark.skipif(sys.platform == "win32", reason="nobody can remove it there")
def test_a_working_directory_that_is_gone_is_one_sentence(tmp_path, capsys, monkeypatch):
    from svu_mi.cli.main import main

    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    for command in COMMANDS:
        place = {"demo": (), "doctor": (), "bench": ()}.get(command, (str(scenes.path("vase")),))
        assert main([command, *place]) == 2
        error = capsys.readouterr().err
        assert error.startswith(GONE) and error.count("\n") == 1


@pytest.mark.skipif(sys.platform == "win32", reason="nobody can remove it there")
def test_help_needs_no_working_directory(tmp_path):
    script = f'mkdir gone; cd gone; rmdir ../gone; exec "{sys.executable}" -m svu_mi --help'
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")


LIGHT = ("-D", "light=window", "--views", "1", "--resolution", "8", "8", "--spp", "1")


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
@pytest.mark.parametrize("option", [(), ("-t", "1"), ("-t", "2")])
def test_one_core_is_enough(tmp_path, option):
    """An environment map in EXR; Mitsuba waits for ever for a worker that one core has not."""
    code = (
        "import os, sys; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "import drjit as dr; assert dr.thread_count() == 1\n"
        "from svu_mi.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    words = ("render", str(scenes.path("vase")), *LIGHT, "-o", str(tmp_path / "out"), *option)
    done = python("-c", "import svu_mi\n" + code, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "view_0000.exr").is_file()


def test_one_thread_is_two_and_says_so(tmp_path):
    scene = write_scene(tmp_path)
    words = ("render", str(scene), "--resolution", "8", "8", "--spp", "1", "-o", "out", "-t", "1")
    done = python("-m", "svu_mi", *words, cwd=tmp_path)
    assert done.returncode == 0
    assert done.stderr == "svu: --threads 1: 2 are used, which Mitsuba needs to read EXR.\n"
    usage = python("-m", "svu_mi", "entropy", "--help", cwd=tmp_path, COLUMNS="300").stdout
    assert "At least 2: Mitsuba cannot read EXR files with one." in usage
