"""Experiments: resumed, cached and failed cases; selection of cases; invalid input."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from support.helpers import sensor_xml, write_scene

from svu_mi import scenes
from svu_mi.bench import BENCHMARKS, captures, experiment
from svu_mi.bench.accuracy import score_posterior
from svu_mi.bench.captures import capture_of, even_views
from svu_mi.bench.cases import Case, convert_glb, data_cases, own_cases
from svu_mi.bench.experiment import BenchRun, Experiment
from svu_mi.bench.markdown import Bar, bar_table
from svu_mi.bench.problem_sizes import ProblemSizes
from svu_mi.bench.result_cache import Store, key_of
from svu_mi.bench.study import Selection, Study, run_bench, without_folders
from svu_mi.capture.scene import load_scene
from svu_mi.cli.main import main
from svu_mi.core.progress import Progress
from svu_mi.errors import MeshError, OptionError, SceneError, ShapeError, SvuWarning
from svu_mi.evaluation.ground_truth import GroundTruth

CASES = own_cases(["vase"], ["window"])


# --- experiments --------------------------------------------------------------------------


@dataclass(frozen=True)
class Letter:
    label: str


@dataclass(frozen=True)
class Word:
    """A case that counts letters and lists its measurements; a dot is an error."""

    name: str
    rows: tuple[Letter, ...]
    measured: list[str] = field(default_factory=list)

    @property
    def title(self):
        return f"the word {self.name}"

    def settings(self, row):
        return self.name, row and row.label

    def head(self):
        self.measured.append("head")
        return {"word": self.name}

    def measure(self, row):
        self.measured.append(row.label)
        if row.label == "!":
            raise KeyboardInterrupt
        if row.label == ".":
            raise SceneError("a dot")
        return {"count": self.name.count(row.label)}


def run_words(bench, *words, letters="ab", reports=None, whole=False):
    """Return the record, and the measurements of each word."""
    subjects = [Word(name, tuple(map(Letter, letters))) for name in words]
    record = Experiment("words", subjects, whole).run(bench, reports)
    return record, [subject.measured for subject in subjects]


@pytest.fixture
def bench(tmp_path):
    return BenchRun(tmp_path)


def test_every_row_of_every_case_is_measured(bench):
    reports = []
    record, measured = run_words(
        bench, "abba", "bar", reports=lambda record: reports.append(len(record["cells"]))
    )
    assert record["cells"] == [
        {"word": "abba", "rows": {"a": {"count": 2}, "b": {"count": 2}}},
        {"word": "bar", "rows": {"a": {"count": 1}, "b": {"count": 1}}},
    ]
    assert reports == [1, 2] and len(record["code"]) == 1 and record["failed"] == []
    assert measured == [["head", "a", "b"]] * 2


def test_finished_rows_are_not_measured_again(bench):
    first, _ = run_words(bench, "abba")
    again, measured = run_words(bench, "abba", "bar", letters="abr")
    assert measured == [["r"], ["head", "a", "b", "r"]]
    assert again["cells"][0]["rows"]["a"] == first["cells"][0]["rows"]["a"]
    _, measured = run_words(replace(bench, fresh=True), "abba")
    assert measured == [["head", "a", "b"]]


def test_an_interrupted_run_is_continued(bench):
    with pytest.raises(KeyboardInterrupt):
        run_words(bench, "abba", "bar", letters="a!b")
    record, measured = run_words(bench, "abba", "bar")
    assert measured == [["b"], ["head", "a", "b"]] and len(record["cells"]) == 2


def test_results_of_another_version_need_an_option(bench, monkeypatch):
    run_words(bench, "abba")
    monkeypatch.setattr(experiment, "code_now", lambda: "other")
    for how in ({"keep": True}, {"stored": True}):
        record, measured = run_words(replace(bench, **how), "abba", letters="ab")
        assert measured == [[]] and len(record["cells"]) == 1
    record, measured = run_words(replace(bench, keep=True), "abba", letters="abc")
    assert measured == [["c"]] and len(record["code"]) == 2
    assert run_words(bench, "abba")[1] == [["head", "a", "b"]]
    record, measured = run_words(replace(bench, stored=True), "abba", "bar", letters="abd")
    assert measured == [[], []] and list(record["cells"][0]["rows"]) == ["a", "b"]


def test_failed_rows_are_reported_and_skipped(bench):
    with pytest.warns(SvuWarning, match="the word abba: [.] is skipped: a dot"):
        record, _ = run_words(bench, "abba", letters="a.")
    assert record["failed"] == [{"cell": "the word abba: .", "reason": "a dot"}]
    assert list(record["cells"][0]["rows"]) == ["a"]
    with pytest.warns(SvuWarning, match="the word bar is skipped"), pytest.raises(SceneError):
        run_words(bench, "bar", letters="a.", whole=True)
    study = Study(title="Words", experiment=None, tables=lambda _: ["none"])
    text = study.markdown({**record, "bars": [], "code": ["a", "b", "c"]})
    assert "| the word abba: . | a dot |" in text and "3 versions of the code" in text


def test_a_module_and_a_line_add_a_benchmark(bench, monkeypatch):
    """As in CONTRIBUTING.md: a name in ``BENCHMARKS``, and a module with a ``STUDY``."""
    letters = (Letter("a"),)
    module = ModuleType("svu_mi.bench.words")
    module.STUDY = Study(
        title="Words", tables=lambda record: [str(record["longest"])],
        experiment=lambda _, chosen: Experiment("words", [Word(chosen.cases[0].object, letters)]),
        summary=lambda record: {**record, "longest": record["cells"][0]["word"]},
        bars=lambda record: [Bar("letters", len(record["longest"]), 3.0)],
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(BENCHMARKS, "words", "counts letters")
    record = run_bench(bench, ["words"], Selection(cases=CASES), "svu bench words")
    assert record["words"]["cells"] == [{"word": "vase", "rows": {"a": {"count": 1}}}]
    text = (bench.folder / "bench.md").read_text()
    assert "# Words" in text and "| letters | 4 | <= 3 | **no** |" in text and "\nvase" in text
    again = run_bench(replace(bench, stored=True), ["words"], Selection(cases=CASES), "again")
    assert again["words"]["command"] == "svu bench words"  # stored results keep their provenance


def test_a_record_counts_only_under_its_key(tmp_path):
    store = Store(tmp_path / "store")
    key = key_of({"a": 1}, (2, 3))
    assert key == key_of({"a": 1}, [2, 3]) != key_of({"a": 2}, [2, 3])
    assert store.load("x", key) is None
    assert store.save("x", key, {"value": np.float32(0.5)}) == {"value": 0.5, "key": key}
    assert store.load("x", key) == {"value": 0.5, "key": key}
    assert store.load("x", "other") is None
    for broken in ('{"value": 0.', "[]"):
        store.path("x").write_text(broken)
        assert store.load("x", key) is None


# --- selection -----------------------------------------------------------------------------


def test_an_unknown_benchmark_is_refused(tmp_path, capsys, variant):
    assert main(["bench", "power", "-o", str(tmp_path)]) == 2
    assert f"use one of {', '.join(BENCHMARKS)}, all" in capsys.readouterr().err
    assert main(["bench", "recovery", "--rows", "poth", "--stored", "-o", str(tmp_path)]) == 2
    assert "Unknown row 'poth'" in capsys.readouterr().err


def test_bad_folders_end_with_one_line_and_status_2(tmp_path, capsys, variant):
    def words(data):
        assert main(["bench", "accuracy", "--data", str(data), "-o", str(tmp_path / "o")]) == 2
        return capsys.readouterr().err

    assert "objects: no such folder; --data needs a folder with objects" in words(tmp_path / "none")
    (tmp_path / "objects").mkdir()
    assert "objects: no object found" in words(tmp_path)
    box(tmp_path / "objects", roughnessFactor=0.5)
    assert "envmaps: no such folder; --data needs a folder with lat-long images" in words(tmp_path)
    (tmp_path / "envmaps").mkdir()
    assert "envmaps: no lat-long image found" in words(tmp_path)
    mi.set_log_level(mi.LogLevel.Warn)


# --- photographs --------------------------------------------------------------------------


@pytest.mark.slow
def test_photographs_with_other_settings_are_rendered_again(tmp_path, monkeypatch):
    rendered, render = [], captures.render_capture
    monkeypatch.setattr(captures, "render_capture",
                        lambda *a, **k: rendered.append(1) or render(*a, **k))  # fmt: skip
    (case,) = CASES
    small = ProblemSizes(views=6, film=8, spp=1)
    for settings, count in ((small, 1), (small, 1), (replace(small, spp=2), 2)):
        whole = capture_of(case, settings, tmp_path / "capture", Progress())
        assert len(rendered) == count
    (tmp_path / "capture" / "bench.json").write_text("{")  # a damaged mark is ignored
    capture_of(case, replace(small, spp=2), tmp_path / "capture", Progress())
    assert len(rendered) == 3
    half = even_views(whole, 3)  # evenly
    assert half.names == ("view_0000.exr", "view_0002.exr", "view_0005.exr")
    assert len(half.images) == len(half.masks) == half.count == 3
    assert even_views(whole, 6).names == whole.names


@pytest.mark.slow
def test_photographs_of_a_scene_that_has_moved_are_used(tmp_path):
    """As after an installation in another folder."""
    (tmp_path / "first").mkdir()
    scene = write_scene(tmp_path / "first", sensors=sensor_xml(2, 8, 8))
    small = ProblemSizes(views=3, film=8, spp=1)
    before = capture_of(Case("ball", "light", scene), small, tmp_path / "shots", Progress())
    (tmp_path / "first").rename(tmp_path / "second")
    moved, progress = Case("ball", "light", tmp_path / "second" / scene.name), Progress()
    after = capture_of(moved, small, tmp_path / "shots", progress)
    assert list(progress.timings) == ["Loading ball / light"]
    np.testing.assert_array_equal(after.images, before.images)


# --- data of the user's -------------------------------------------------------------------


def box(folder: Path, name: str = "thing.glb", **material) -> Path:
    """A GLB of one upright square, z = 0, x and y in [0, 2], with v = 0 at its top (glTF)."""
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], float)
    # trimesh has v = 0 at the bottom, and writes glTF turned over.
    visual = trimesh.visual.TextureVisuals(
        uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float),
        material=trimesh.visual.material.PBRMaterial(**material),
    )
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    path = folder / name
    mesh.export(path)
    return path


def pictures():
    """Base colour: red in the top rows, green below. Roughness rises to the right."""
    base = np.zeros((8, 8, 3), np.uint8)
    base[:4, :, 0] = base[4:, :, 1] = 255
    packed = np.zeros((8, 8, 3), np.uint8)
    packed[..., 1] = np.arange(8) * 30
    packed[..., 2] = 200
    return Image.fromarray(base), Image.fromarray(packed)


def parameters_at(folder, uvs):
    """Return the parameters of Mitsuba's scene of the folder at UVs."""
    light = scenes.FOLDER / "lights" / "studio.exr"
    scene = load_scene(scenes.path("object"), {"object": str(folder), "environment": str(light)})
    si = mi.SurfaceInteraction3f()
    si.uv = mi.Point2f(*np.array(uvs, np.float32).T.copy())
    bsdf = scene.shapes()[0].bsdf()
    return (
        np.array(bsdf.eval_attribute("base_color", si)).T,
        np.array(bsdf.eval_attribute_1("roughness", si)),
        np.array(bsdf.eval_attribute_1("metallic", si)),
        scene.shapes()[0],
    )


def test_a_glb_keeps_its_pictures_where_they_were(tmp_path):
    """The top of the object is the red top of the picture; G is roughness and B metallic."""
    base, packed = pictures()
    path = box(tmp_path, baseColorTexture=base, metallicRoughnessTexture=packed,
               roughnessFactor=0.5, metallicFactor=1.0)  # fmt: skip
    folder = convert_glb(path, tmp_path / "converted")
    mesh = trimesh.load(folder / "mesh.ply", process=False)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1).max(), 1, rtol=1e-5)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0, atol=1e-6)
    _, _, _, shape = parameters_at(folder, [[0.5, 0.5]])
    params = mi.traverse(shape)
    points = np.array(params["vertex_positions"]).reshape(-1, 3)
    uvs = np.array(params["vertex_texcoords"]).reshape(-1, 2)
    top_right = np.argmax(points[:, 0] + points[:, 1])
    bottom_left = np.argmin(points[:, 0] + points[:, 1])
    inward = [0.8 * uvs[top_right] + 0.1, 0.8 * uvs[bottom_left] + 0.1]
    color, rough, metal, _ = parameters_at(folder, inward)
    np.testing.assert_allclose(color, [[1, 0, 0], [0, 1, 0]], atol=1e-3)
    assert rough[0] > 0.3 > 0.1 > rough[1]  # 0.5 of 180 to 210 of 255; almost 0 on the left
    np.testing.assert_allclose(metal, 200 / 255, atol=1e-3)


def test_glb_files_that_are_refused(tmp_path):
    (tmp_path / "bad.glb").write_bytes(b"not a GLB")
    with pytest.raises(MeshError, match="bad.glb: not a readable mesh"):
        convert_glb(tmp_path / "bad.glb", tmp_path / "c")
    trimesh.creation.box().export(tmp_path / "plain.glb")
    with pytest.raises(MeshError, match="plain.glb: the mesh has no UVs"):
        convert_glb(tmp_path / "plain.glb", tmp_path / "c")
    scene = trimesh.Scene()
    for factor in (0.25, 0.5):
        box(tmp_path, "part.glb", roughnessFactor=factor)
        scene.add_geometry(next(iter(trimesh.load_scene(tmp_path / "part.glb").geometry.values())))
    scene.export(tmp_path / "two.glb")
    with pytest.raises(MeshError, match="two.glb: needs exactly one material"):
        convert_glb(tmp_path / "two.glb", tmp_path / "c")


def test_objects_and_environments_of_a_folder(tmp_path):
    data = tmp_path / "data"
    (data / "objects" / "cup").mkdir(parents=True)
    for name in ("mesh.ply", "base_color.png", "roughness.png", "metallic.png"):
        (data / "objects" / "cup" / name).touch()
    box(data / "objects", roughnessFactor=0.5)
    (data / "envmaps").mkdir()
    for name in ("sky.exr", "sky.hdr", "room.hdr"):
        (data / "envmaps" / name).touch()
    cases = data_cases(data, tmp_path / "work")
    assert [case.title for case in cases] == [
        "cup / room", "cup / sky", "thing / room", "thing / sky"
    ]  # fmt: skip
    assert cases[1].defines["environment"].endswith("sky.exr")  # before Radiance
    assert (tmp_path / "work" / "objects" / "thing" / "roughness.png").is_file()
    (only,) = data_cases(data, tmp_path / "work", ["cup"], ["sky"])
    assert Path(only.defines["object"]) == (data / "objects" / "cup").resolve()
    with pytest.raises(OptionError, match="'jug'; use one of cup, thing"):
        data_cases(data, tmp_path / "work", ["jug"])
    (data / "objects" / "cup" / "metallic.png").unlink()
    with pytest.raises(OptionError, match="cup: an object's folder needs .* add metallic.png"):
        data_cases(data, tmp_path / "work")


# --- parts --------------------------------------------------------------------------------


def test_a_posterior_at_the_truth_is_judged_perfect():
    """All mass on the true cells, per channel and grey."""
    rng = np.random.default_rng(5120)
    nodes = np.linspace(0, 1, 5)
    pick = rng.integers(0, 5, (2, 30))
    colors = rng.integers(0, 5, (30, 3))
    truth = GroundTruth(base_color=nodes[colors], roughness=nodes[pick[0]],
                        metallic=nodes[pick[1]])  # fmt: skip
    axes = {"roughness": nodes, "base_color": nodes}
    p = np.zeros((30, 5, 5, 3))
    p[np.arange(30)[:, None], pick[0][:, None], colors, np.arange(3)] = 1
    kept = np.arange(30)
    scores = score_posterior(p, axes, truth, rng.random(30), kept)
    assert scores["credible"]["0.5"]["plain"] == 1
    assert all(figures["rmse"] == 0 for figures in scores["parameters"].values())
    assert scores["ause"] == 0
    grey = score_posterior(np.eye(5)[pick[0]], {"roughness": nodes}, truth, rng.random(30), kept)
    assert grey["parameters"]["roughness"]["mae"] == 0
    with pytest.raises(ShapeError, match="do not fit a grid of"):
        score_posterior(p[:, :4], axes, truth, rng.random(30), kept)


def test_a_bar_is_an_upper_or_a_lower_limit():
    assert Bar("time", 1.0, 2.0, "s").holds
    assert not Bar("time", 3.0, 2.0, "s").holds
    assert Bar("rate", 3.0, 2.0, least=True).holds
    assert not Bar("error", math.nan, 2.0).holds
    assert not Bar("rate", math.nan, 2.0, least=True).holds
    text = "\n".join(bar_table([Bar("time", 3.0, 2.0, "s").record()], quick=True))
    assert "| time | 3 s | <= 2 s | **no** |" in text and "Quick sizes" in text
    assert bar_table([]) == []


def test_folders_of_a_machine_stay_out_of_records():
    case = {"cell": "vase / window", "reason": "/tmp/a b/mesh.ply: not a mesh", "value": 1.5}
    record = {"command": "svu bench orb --data '/home/me/orb' -o /tmp/out", "cells": [case]}
    assert without_folders(record) == {
        "command": "svu bench orb --data 'orb' -o out",
        "cells": [{**case, "reason": "a b/mesh.ply: not a mesh"}],
    }
