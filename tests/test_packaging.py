"""The installed package equals the tree, and its import is fast."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
import venv

import pytest

import svu_mi

HEAVY = ("mitsuba", "drjit", "numpy", "matplotlib", "torch", "scipy", "rich", "OpenEXR")
IMPORT_BUDGET_MS = 50  # Mitsuba 3.10 imports svu_mi for everybody who has it installed


@pytest.fixture(scope="module")
def project(root):
    return tomllib.loads((root / "pyproject.toml").read_text())


def test_package_list_equals_the_tree(root, project):
    inside = {
        ".".join(path.parent.relative_to(root).parts)
        for path in (root / "svu_mi").rglob("__init__.py")
    }
    listed = project["tool"]["setuptools"]["packages"]
    assert len(listed) == len(set(listed))
    assert set(listed) == inside | {"svu_mi.plugins", "svu_mi.scenes"}


def test_every_folder_with_code_is_a_package(root):
    """Without its ``__init__.py`` a folder is found here and missing from the wheel."""
    for path in (root / "svu_mi").rglob("*.py"):
        assert (path.parent / "__init__.py").is_file(), path.parent


def in_fresh_process(code, *options):
    done = subprocess.run(
        [sys.executable, *options, "-c", code],
        capture_output=True, text=True, timeout=60, env=os.environ | {"MI_DEFAULT_VARIANT": ""},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done


def test_import_loads_nothing_heavy():
    code = "import svu_mi, sys, json; print(json.dumps(sorted(sys.modules)))"
    loaded = json.loads(in_fresh_process(code).stdout)
    assert not [name for name in HEAVY if name in loaded]


@pytest.mark.parametrize("words", [["--help"], ["guide", "--help"]])
def test_help_loads_neither_renderer_nor_plots(words):
    code = f"""import sys, json, contextlib, os
from svu_mi.cli.main import main
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(open(os.devnull, "w")):
    main({words})
print(json.dumps(sorted(sys.modules)))"""
    loaded = json.loads(in_fresh_process(code).stdout)
    assert "svu_mi.guidance.guidance_options" in loaded
    assert not {"drjit", "mitsuba", "matplotlib", "scipy", "trimesh"}.intersection(loaded)


def test_import_is_fast():
    """The best of many, since other work on the machine only ever adds time."""
    times_ms: list[float] = []
    while len(times_ms) < 20 and not (times_ms and times_ms[-1] < IMPORT_BUDGET_MS):
        lines = in_fresh_process("import svu_mi", "-X", "importtime").stderr.splitlines()
        (line,) = [text for text in lines if text.split("|")[-1].strip() == "svu_mi"]
        times_ms.append(int(line.split("|")[1]) / 1000)
    assert min(times_ms) < IMPORT_BUDGET_MS, times_ms


def test_import_sets_no_variant():
    code = "import svu_mi, mitsuba; print(mitsuba.variant())"
    assert in_fresh_process(code).stdout.split() == ["None"]


def test_import_of_plugins_sets_no_variant():
    code = "import svu_mi.plugins, mitsuba; print(mitsuba.variant())"
    assert in_fresh_process(code).stdout.split() == ["None"]


def test_every_public_name_has_a_home():
    """``import *`` would fail on a name in ``__all__`` that cannot be loaded."""
    assert set(svu_mi.__all__) == set(svu_mi._HOME)


@pytest.mark.slow
def test_wheel_of_the_sdist_runs_outside_of_the_tree(root, tmp_path):
    """Build sdist and wheel; install the wheel beside the dependencies of this environment."""

    def run(*words, cwd=tmp_path):
        done = subprocess.run(words, cwd=cwd, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path / "dist", root)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    assert len(list((tmp_path / "dist").glob("*.tar.gz"))) == 1
    venv.create(tmp_path / "env")
    python = tmp_path / "env" / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", wheel)
    (packages,) = (tmp_path / "env" / "lib").glob("python*/site-packages")
    installed = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "dependencies.pth").write_text("\n".join(installed))
    svu = tmp_path / "env" / "bin" / "svu"
    assert run(svu, "--version").split()[-1] == svu_mi.__version__
    run(svu, "scenes", "vase")
    run(svu, "render", "scenes/vase/vase.xml", "--views", "3", "--resolution", "32", "--spp", "1",
        "-D", "light=window", "-o", "capture")  # fmt: skip
    place = run(python, "-c", "import svu_mi.plugins, svu_mi.scenes; print(svu_mi.__file__)")
    assert place.startswith(str(packages))
