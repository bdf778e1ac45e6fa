"""Folders with files of two runs, and folders that hold somebody else's photographs."""

from __future__ import annotations

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from support.helpers import ball, fails, lettered, names, run, write_scene

from svu_mi.capture import loading
from svu_mi.core.io.exr import read_header, write_exr
from svu_mi.core.io.files import stamp, stamped, write_json
from svu_mi.core.io.provenance import are_of_one_capture, marks_of, require_one_run
from svu_mi.errors import CaptureError, SvuWarning
from svu_mi.output.export.load_asset import load_asset
from svu_mi.output.texture_files import write_textures
from svu_mi.output.viewer.viewer import Viewer

SMALL = ("--resolution", 16)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two captures of different light, with entropy and textures of each.

    Light of one kind, for which kernels are compiled once.
    """
    at = tmp_path_factory.mktemp("made")
    for which, radiance in (("a", 1), ("b", 2)):
        (at / which).mkdir()
        path = write_scene(at / which)
        bright = f'id="light"><rgb name="radiance" value="{radiance}"/></emitter>'
        path.write_text(path.read_text().replace('id="light"/>', bright))
        shot, textures, maps = (at / which / name for name in ("shot", "r", "e"))
        assert run("render", path, "-o", shot, "--spp", 1) == 0
        assert run("recover", shot, *SMALL, "--steps", 2, "--no-pictures", "-o", textures) == 0
        assert run("entropy", shot, *SMALL, "--no-pictures", "-o", maps) == 0
    return at


@pytest.fixture
def result(made, tmp_path):
    """A copy of the first recovery."""
    return shutil.copytree(made / "a" / "r", tmp_path / "r")


@pytest.mark.slow
def test_every_file_of_a_result_has_the_id_of_its_run(made):
    folder = made / "a" / "r"
    entry = json.loads((folder / "run.json").read_text())["written"]
    assert entry["command"] == "recover" and len(entry["capture"]) == 32
    marked = [name for name in entry["files"] if name.endswith((".exr", ".xml", ".ply"))]
    assert len(marked) == 8
    for name in marked:
        assert marks_of(folder / name) == (entry["run"], entry["capture"]), name
    files = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    assert files == sorted([*entry["files"], "run.json"])
    assert read_header(made / "a" / "shot" / "view_0000.exr").attributes["svu:run"]


@pytest.mark.parametrize(
    "name", ["roughness.exr", "metallic.exr", "recovered.xml", "assets/mesh.ply", "run.json"]
)
def test_a_file_of_another_run_is_refused(made, result, tmp_path, capsys, name):
    shutil.copy(made / "b" / "r" / name, result / name)
    line = fails(capsys, "export", result, "-o", tmp_path / "asset")
    assert f"base_color.exr and {name} come from different runs; take both from one run" in line
    assert names(tmp_path) == ["r"]
    if name.endswith(".exr") or name == "run.json":
        words = ("report", made / "a" / "shot", *SMALL, "--recovered", result)
        assert "come from different runs" in fails(capsys, *words, "-o", tmp_path / "page.html")


def test_maps_of_another_capture_are_refused(made, result, tmp_path, capsys):
    other = made / "b" / "e"
    shutil.copy(other / "coverage.exr", result / "coverage.exr")
    line = fails(capsys, "export", result, "-o", tmp_path / "asset")
    assert "entropy.exr and coverage.exr come from different runs" in line
    shutil.copy(other / "entropy.exr", result / "entropy.exr")
    line = fails(capsys, "export", result, "-o", tmp_path / "asset")
    assert "entropy.exr: comes from another capture than" in line
    with pytest.warns(SvuWarning, match="comes from another capture"):  # as asked for
        load_asset(result, other)
    assert run("export", result, "--entropy", made / "a" / "e", "-o", tmp_path / "asset") == 0


@pytest.mark.filterwarnings("default::svu_mi.errors.SvuWarning")
@pytest.mark.parametrize("command", ["report", pytest.param("view", marks=pytest.mark.slow)])
def test_textures_of_another_mesh_are_refused(made, result, tmp_path, capsys, monkeypatch, command):
    monkeypatch.setattr(Viewer, "run", lambda self: self.stop())
    page = SimpleNamespace(summary=str)  # takes long, and others look at it
    listed = []
    monkeypatch.setattr(
        "svu_mi.output.report.report.write_report",
        lambda capture, *_, **__: listed.append(capture.warnings) or page,
    )
    there = ("-o", tmp_path / "page.html") if command == "report" else ("--port", 0)
    of_first, of_second = (
        (command, made / which / "shot", *there, "--recovered") for which in "ab"
    )
    capsys.readouterr()
    assert run(*of_first, result) == 0
    assert "another" not in capsys.readouterr().err
    assert run(*of_second, result) == 0
    assert (
        f"svu: warning: {result}: these textures come from another capture than "
        f"{made / 'b' / 'shot'}; their values are used as they are.\n"
    ) in capsys.readouterr().err
    assert [len(each) for each in listed] == ([0, 1] if command == "report" else [])
    scene = write_scene(tmp_path, uvs=0.5 * ball().uvs)
    other = ("--render", "--spp", 1, "-o", tmp_path / "other.html")
    assert fails(capsys, command, scene, "--recovered", result, *other).startswith(
        f"svu: {result}: these textures belong to another mesh or other UVs than "
    )
    (tmp_path / "anybody").mkdir()
    write_textures(lettered(16, 16), tmp_path / "anybody")
    assert run(*of_second, tmp_path / "anybody") == 0
    assert "another" not in capsys.readouterr().err


def test_a_file_that_is_missing_is_named(made, result, tmp_path, capsys):
    (result / "metallic.exr").unlink()
    line = fails(capsys, "export", result, "-o", tmp_path / "asset")
    assert "has no metallic.exr, which svu recover wrote; run it again" in line


def test_error_names_missing_scene_of_moved_capture(made, tmp_path, capsys):
    shutil.copytree(made / "a" / "shot", tmp_path / "far" / "away")
    line = fails(capsys, "entropy", tmp_path / "far" / "away", "-o", tmp_path / "out")
    assert "capture.json: its scene" in line and "does not exist; copy it there" in line


def test_a_photograph_of_another_run_is_refused(made, tmp_path, capsys):
    shot = shutil.copytree(made / "a" / "shot", made / "a" / "mixed")
    shutil.copy(made / "b" / "shot" / "view_0001.exr", shot / "view_0001.exr")
    line = fails(capsys, "entropy", shot, *SMALL, "-o", tmp_path / "out")
    assert "view_0001.exr: written by another run than the capture.json in its folder" in line
    write_exr(shot / "view_0001.exr", {"RGB": np.full((24, 24, 3), 0.5)})  # one's own
    assert run("entropy", shot, *SMALL, "-o", tmp_path / "out") == 0


def test_capture_replaced_while_read_is_refused(made, monkeypatch):
    shot = shutil.copytree(made / "a" / "shot", made / "a" / "exchanged")

    read = loading.read_photographs

    def exchange(*arguments, **options):
        result = read(*arguments, **options)
        shutil.copy(made / "b" / "shot" / "capture.json", shot / "capture.json")
        return result

    with monkeypatch.context() as patch:
        patch.setattr(loading, "read_photographs", exchange)
        with pytest.raises(CaptureError, match="changed while it was being read; load it again"):
            loading.load_capture(shot)


def test_textures_without_run_id_are_accepted(result, tmp_path):
    for name, channels in (("base_color", "RGB"), ("roughness", "Y"), ("metallic", "Y")):
        shape = (16, 16, 3) if channels == "RGB" else (16, 16)
        write_exr(result / f"{name}.exr", {channels: np.full(shape, 0.5)})
    assert run("export", result, "-o", tmp_path / "asset") == 0


def test_files_have_the_marks_of_their_run(tmp_path):
    with stamped({"svu:run": "12ab", "svu:capture": "34cd"}):
        write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 2))}, {"svu:method": "sh"})
        (tmp_path / "a.xml").write_text(f"<!-- {' '.join(f'{k}={v}' for k, v in stamp().items())}")
    write_exr(tmp_path / "b.exr", {"Y": np.zeros((2, 2))})
    assert read_header(tmp_path / "a.exr").attributes["svu:method"] == "sh"
    assert marks_of(tmp_path / "a.exr") == marks_of(tmp_path / "a.xml") == ("12ab", "34cd")
    assert marks_of(tmp_path / "b.exr") == ("", "")


def test_readers_refuse_files_of_two_runs(tmp_path):
    def marked(name: str, run: str, capture: str = "") -> None:
        with stamped({"svu:run": run, "svu:capture": capture}):
            write_exr(tmp_path / name, {"Y": np.zeros((2, 2))})

    marked("a.exr", "12ab", "01")
    marked("b.exr", "12ab", "01")
    write_exr(tmp_path / "mine.exr", {"Y": np.zeros((2, 2))})
    files = ["a.exr", "b.exr", "mine.exr"]
    require_one_run(tmp_path, files, "run.json", "recover")
    marked("b.exr", "34cd", "02")
    with pytest.raises(CaptureError, match=r"a.exr and b.exr come from different runs; take both"):
        require_one_run(tmp_path, files, "run.json", "recover")
    assert not are_of_one_capture(tmp_path / "a.exr", tmp_path / "b.exr")
    assert are_of_one_capture(tmp_path / "a.exr", tmp_path / "mine.exr")
    entry = {"run": "56ef", "command": "recover", "capture": "", "files": {}}
    write_json(tmp_path / "run.json", {"written": entry})
    with pytest.raises(CaptureError, match=r"a.exr and run.json come from different runs"):
        require_one_run(tmp_path, ["a.exr"], "run.json", "recover")


# --- photographs of others ----------------------------------------------------------------


@pytest.mark.parametrize("command", ["render", "import"])
@pytest.mark.parametrize("what", ["photograph", "edited", "notes", "imported"])
def test_a_capture_that_others_have_worked_on_is_left_alone(made, tmp_path, capsys, command, what):
    """Both write to ``capture`` by default; neither deletes what it has not made there."""
    shot = shutil.copytree(made / "a" / "shot", tmp_path / "capture")
    name = {"photograph": "view_0003.exr", "notes": "notes.txt"}.get(what, "view_0000.exr")
    if what == "imported":
        record = json.loads((shot / "capture.json").read_text())
        record["written"]["command"] = "import" if command == "render" else "render"
        (shot / "capture.json").write_text(json.dumps(record))
    else:
        (shot / name).write_bytes(b"mine")
    before = {path.name: path.read_bytes() for path in shot.iterdir() if path.is_file()}
    given = {"render": made / "a" / "scene.xml", "import": made / "none"}[command]
    line = fails(capsys, command, given, "-o", shot)
    assert command == "import" or "contains other files" in line
    assert {path.name: path.read_bytes() for path in shot.iterdir() if path.is_file()} == before


def test_a_scene_that_cannot_be_rendered_costs_no_photograph(made, tmp_path, capsys):
    shot = shutil.copytree(made / "a" / "shot", tmp_path / "capture")
    before = {path.name: path.read_bytes() for path in shot.iterdir() if path.is_file()}
    (tmp_path / "scene.xml").write_text("<scene version='3.0.0'></scene>")
    fails(capsys, "render", tmp_path / "scene.xml", "-o", shot)
    assert {path.name: path.read_bytes() for path in shot.iterdir() if path.is_file()} == before
    assert run("render", made / "b" / "scene.xml", "-o", shot, "--spp", 1) == 0  # its own may go
