"""Places to run from: foreign settings, a folder that is gone, a machine with one core."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.helpers import python

from svu_mi import scenes

SETTINGS = """backend: module://evil
figure.facecolor: red
text.usetex: True
axes.prop_cycle: cycler(color=["red"])
no such setting
"""
SHOW = """
import sys
from svu_mi.cli.matplotlib_setup import import_matplotlib
import_matplotlib()
import matplotlib, os
from matplotlib import rcParams, rcParamsDefault
changed = {key for key in rcParams if rcParams._get(key) != rcParamsDefault._get(key)}
print(sorted(changed - {"backend", "backend_fallback"}))
print(type(rcParams._get("backend")) is str, os.getcwd(), os.environ.get("MPLBACKEND"))
"""


@pytest.mark.parametrize(
    ("end", "backend"),
    [(b"", ""), (b"", "module://evil"), (b"font.size: \xff\xfe", "nonsense")],
    ids=["foreign", "evil", "no text"],
)
def test_settings_of_the_working_directory_are_not_read(tmp_path, end, backend):
    """Unless ignored, bytes that are no text, and an unknown backend, are errors on import."""
    (tmp_path / "matplotlibrc").write_bytes(SETTINGS.encode() + end)
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')")
    done = python("-c", SHOW, cwd=tmp_path, MPLBACKEND=backend, MATPLOTLIBRC=str(tmp_path))
    assert done.stderr == ""
    assert done.stdout.splitlines() == ["[]", f"False {tmp_path} {backend or ''}"]


def test_only_commands_that_draw_import_matplotlib():
    """What renders, imports or diagnoses, the photographs of others too, needs none of it."""
    code = (
        "import sys, svu_mi.cli.main as program\n"
        "assert 'matplotlib' not in sys.modules\n"
        "run = lambda self, console: ('matplotlib' in sys.modules) != self.uses_matplotlib\n"
        "program.Render.run = program.Import.run = program.Doctor.run = program.Entropy.run = run\n"
        "words = (['render', 'x'], ['import', 'x'], ['doctor'], ['entropy', 'x'])\n"
        "sys.exit(any(map(program.main, words)))"
    )
    assert python("-c", code, cwd=Path.cwd()).returncode == 0


def test_an_imported_matplotlib_is_left_alone(tmp_path):
    code = (
        "import matplotlib; matplotlib.rcParams['font.size'] = 3\n"
        "from svu_mi.cli.matplotlib_setup import import_matplotlib\n"
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


@pytest.mark.few(1)
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
@pytest.mark.parametrize(
    ("option", "said"),
    [((), ""), (("-t", 1), "svu: --threads 1: using 2, which Mitsuba needs to read EXR.\n")],
)
def test_one_core_is_enough(tmp_path, option, said):
    """An environment map in EXR; Mitsuba waits for ever for a worker that one core has not."""
    code = (
        "import svu_mi, os, sys; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "import drjit as dr; assert dr.thread_count() == 1\n"
        "from svu_mi.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    words = ("render", scenes.path("vase"), *LIGHT, "-o", tmp_path / "out", *option)
    done = python("-c", code, *words, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, said)
    assert (tmp_path / "out" / "view_0000.exr").is_file()


ONE = "import os, sys; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
PLAIN = """
import svu_mi, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
scene, light = sys.argv[1:]
mi.Bitmap(light)
mi.load_dict({"type": "bitmap", "filename": light})
mi.load_dict({"type": "scene", "light": {"type": "envmap", "filename": light}})
mi.load_file(scene, resolution="8")
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
def test_plain_mitsuba_runs_on_one_core(tmp_path):
    """It waited for ever, in a notebook that shows recovered.xml, say."""
    light = scenes.path("vase").parents[1] / "lights" / "window.exr"
    done = python("-c", ONE + PLAIN, scenes.path("vase"), light, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


COMMAND = "from svu_mi.cli.main import main; sys.exit(main(sys.argv[1:]))"


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
@pytest.mark.parametrize("command", ["demo", "recover"])  # demo renders, then entropy
def test_commands_run_on_one_core(command, shot, tmp_path):
    words = ("demo", "--spp", 1) if command == "demo" else (command, shot)
    done = python(
        "-c", ONE + COMMAND, *words, "--resolution", 24, "-o", tmp_path / "out", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "run.json").is_file()
