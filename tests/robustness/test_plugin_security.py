"""A scene, or the folder to work in, cannot bring a library that Mitsuba runs as a plugin."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import pytest
from support.helpers import python, write_scene

import svu_mi as svu
from svu_mi.capture.plugin_security import own_plugin
from svu_mi.capture.scene import load_scene, require_variant
from svu_mi.cli.main import main
from svu_mi.errors import SceneError

SOURCE = """
#include <stdio.h>
#include <stdlib.h>
__attribute__((constructor)) static void run(void) { fclose(fopen(getenv("LOADED"), "a")); }
"""
TAGS = ("bsdf", "rfilter", "sampler", "phase", "medium", "film", "integrator", "volume", "texture",
        "emitter", "sensor", "shape", "spectrum")  # fmt: skip


# The installed program; ``python -m`` would put the folder on Python's own path.
PROGRAM = "import sys; from svu_mi.cli.main import main; sys.exit(main())"


@pytest.fixture(scope="session")
def library(tmp_path_factory) -> Path:
    """A library that makes the file $LOADED when it is loaded."""
    folder = tmp_path_factory.mktemp("library")
    (folder / "evil.c").write_text(SOURCE)
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or sys.platform != "linux":
        pytest.skip("needs a C compiler on Linux")
    words = [compiler, "-shared", "-fPIC", "-o", "evil.so", "evil.c"]
    subprocess.run(words, cwd=folder, check=True)
    return folder / "evil.so"


@pytest.fixture
def loaded(tmp_path, monkeypatch) -> Path:
    """The file that shows that the library was loaded."""
    monkeypatch.setenv("LOADED", str(tmp_path / "loaded"))
    return tmp_path / "loaded"


def plant(library: Path, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return Path(shutil.copy(library, path))


def scene_of(folder: Path, extra: str = "") -> Path:
    folder.mkdir(exist_ok=True)
    return write_scene(folder, extra=extra)


@pytest.mark.parametrize("name", ["principled", "prb", "hdrfilm", "svu_sh", "anything"])
@pytest.mark.parametrize("place", ["scene", "scene/inner", "scene/included", "scene/path", "."])
def test_a_library_where_mitsuba_would_look_is_refused(
    tmp_path, monkeypatch, library, loaded, place, name
):
    monkeypatch.chdir(tmp_path)
    extra = '<path value="path"/><include filename="included/more.xml"/>'
    path = scene_of(tmp_path / "scene", extra)
    for folder in ("path", "included", "inner"):
        (path.parent / folder).mkdir()
    more = '<scene version="3.0.0"><path value="../inner"/><bsdf type="principled"/></scene>'
    (path.parent / "included" / "more.xml").write_text(more)
    if place == "scene/inner":  # this <path> ends with its file, so nothing is looked for there
        path.write_text(path.read_text().replace('value="path"', 'value="inner"'))
    planted = plant(library, tmp_path / place / "plugins" / f"{name}.so")
    words = rf"{name}\.so: Mitsuba would run this library.*trust=True"
    with pytest.raises(SceneError, match=words):
        svu.load_capture(path)
    assert not loaded.exists()
    planted.unlink()
    load_scene(path)


def test_linked_folder_and_foreign_libraries_are_refused(tmp_path, library, loaded):
    path = scene_of(tmp_path / "scene")
    (tmp_path / "far").mkdir()
    (path.parent / "plugins").symlink_to(tmp_path / "far")
    for suffix in (".so", ".dylib", ".dll", ".DLL"):
        planted = plant(library, tmp_path / "far" / f"diffuse{suffix}")
        with pytest.raises(SceneError, match="Mitsuba would run"):
            load_scene(path)
        planted.unlink()
    (tmp_path / "far" / "loop.so").symlink_to("loop.so")
    with pytest.raises(SceneError, match="Mitsuba would run"):
        load_scene(path)
    (tmp_path / "far" / "loop.so").unlink()
    (tmp_path / "far" / "readme.txt").write_text("no library")
    load_scene(path)
    assert not loaded.exists()


@pytest.mark.parametrize(("tag", "encoding"), [*((tag, "utf-8") for tag in TAGS),
                                               ("bsdf", "utf-16")])  # fmt: skip
def test_no_tag_may_name_a_path(tmp_path, library, loaded, tag, encoding):
    path = scene_of(tmp_path / "scene", f'<{tag} type="../evil"/>')
    path.write_bytes(path.read_text().encode(encoding))
    (path.parent / "plugins").mkdir()
    plant(library, path.parent / "evil.so")
    with pytest.raises(SceneError, match=r"scene\.xml: '\.\./evil' is a path"):
        load_scene(path)
    assert not loaded.exists()


@pytest.mark.parametrize(
    "words, place",
    [
        ('<default name="t" value="evil"/><bsdf type="../$t"/>', "evil.so"),
        ('<bsdf type="&#46;&#46;/evil"/>', "evil.so"),
        ('<bsdf type="sub/evil"/>', "plugins/sub/evil.so"),
        ('<bsdf type="evil.bsdf"/>', "plugins/evil.so"),
        ('<bsdf type="principled.so"/>', "plugins/principled.so"),
        ('<bsdf type="../../evil"/>', "../evil.so"),
        ('<include filename="more.xml"/>', "evil.so"),
        ('<bsdf id="a" type="../evil"/><alias id="a" as="b"/>', "evil.so"),
    ],
)
def test_libraries_elsewhere_are_not_reached_by_tricks(tmp_path, library, loaded, words, place):
    path = scene_of(tmp_path / "scene", words)
    (path.parent / "plugins").mkdir()
    (path.parent / "more.xml").write_text('<bsdf version="3.0.0" type="../evil"/>')
    plant(library, path.parent / place)
    with pytest.raises(SceneError):
        load_scene(path)
    assert not loaded.exists()
    with pytest.raises(SceneError, match="entry point of plugin"):
        load_scene(path, trust=True)
    assert loaded.exists()  # it does lie where Mitsuba looks


def test_libraries_are_loaded_if_trusted(tmp_path, library, loaded, capsys):
    path = scene_of(tmp_path / "scene", '<bsdf type="mine"/>')
    plant(library, path.parent / "plugins" / "mine.so")
    assert main(["render", str(path), "-o", str(tmp_path / "out"), "--spp", "1"]) == 2
    assert "mine.so: Mitsuba would run" in capsys.readouterr().err and not loaded.exists()
    words = ["render", str(path), "-o", str(tmp_path / "out"), "--spp", "1", "--trust"]
    assert main(words) == 2 and "entry point of plugin" in capsys.readouterr().err
    assert loaded.exists()


def test_mitsubas_own_plugins_are_not_replaced_later(tmp_path, monkeypatch, library, loaded):
    require_variant()
    plant(library, tmp_path / "plugins" / "roughconductor.so")
    monkeypatch.chdir(tmp_path)
    assert "RoughConductor" in str(mi.load_dict({"type": "roughconductor"}))
    assert not loaded.exists()


@pytest.mark.parametrize("name", ["prb", "svu_entropy"])
def test_plugins_in_python_are_not_replaced_later(tmp_path, monkeypatch, library, loaded, name):
    """Mitsuba looks for a library of that name every time, wherever the process is by then."""
    plant(library, tmp_path / "plugins" / f"{name}.so")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError, match=rf"{name}.so: Mitsuba would run this library as a plugin"):
        own_plugin({"type": name})
    assert not loaded.exists()
    plant(library, tmp_path / "elsewhere" / "plugins" / "another.so")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert own_plugin({"type": "prb"}) is not None


def test_every_plugin_in_python_is_made_that_way(root):
    """All that is made by a name that Mitsuba has no library for."""
    names = re.compile(r"load_dict\(\s*{\s*(\*\*\w+, )?\"type\": \"(prb|svu_\w+)")
    for path in (root / "svu_mi").rglob("*.py"):
        assert not names.search(path.read_text()), path


def test_plugins_that_the_caller_registers_need_no_trust(tmp_path):
    class Mine(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)

    mi.register_bsdf("my_own_bsdf", Mine)
    assert load_scene(scene_of(tmp_path / "scene", '<bsdf type="my_own_bsdf"/>')).shapes()


def test_an_unknown_type_is_one_sentence(tmp_path):
    path = scene_of(tmp_path / "scene", '<bsdf type="nonesuch"/>')
    with pytest.raises(SceneError, match=r'scene\.xml: .*Plugin "nonesuch" not found!'):
        load_scene(path)


def test_paths_of_a_scene_end_with_it(tmp_path):
    before = list(map(str, mi.file_resolver()))
    path = scene_of(tmp_path / "scene", '<path value="inner"/>')
    (path.parent / "inner").mkdir()
    load_scene(path)
    assert list(map(str, mi.file_resolver())) == before


@pytest.mark.parametrize("command", [
    "import .", "render scene.xml",
    *(pytest.param(words, marks=pytest.mark.slow) for words in ("export .", "check .")),
])  # fmt: skip
def test_commands_load_nothing_from_where_they_run(tmp_path, library, loaded, command):
    """In processes of their own, whose Mitsuba has loaded no plugin yet."""
    scene_of(tmp_path)
    for name in ("ply", "perspective", "hdrfilm", "prb"):
        plant(library, tmp_path / "plugins" / f"{name}.so")
    done = python("-P", "-c", PROGRAM, *command.split(), cwd=tmp_path)
    assert not loaded.exists()
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr


@pytest.mark.slow
def test_the_doctor_runs_nothing_from_where_it_is_asked(tmp_path, library, loaded):
    for name in ("direct", "constant", "sphere", "perspective"):
        plant(library, tmp_path / "plugins" / f"{name}.so")
    for name in ("mitsuba", "svu_mi", "numpy"):
        (tmp_path / f"{name}.py").write_text(f"open({str(loaded)!r}, 'w')")
    done = python("-P", "-c", PROGRAM, "doctor", cwd=tmp_path)
    assert not loaded.exists()
    assert "mean 1.0" in done.stdout + done.stderr
