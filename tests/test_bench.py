"""The benchmark: end to end on a minuscule setting, resumed, and on bad or foreign data."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image

from svu_mi import scenes
from svu_mi.bench import accuracy, run_bench, speed
from svu_mi.bench.captures import capture_of, some_views
from svu_mi.bench.cells import data_cells, own_cells
from svu_mi.bench.glb import convert_glb
from svu_mi.bench.judge import judge_posterior
from svu_mi.bench.sizes import QUICK, Sizes
from svu_mi.bench.store import Store, key_of
from svu_mi.bench.text import seconds, table
from svu_mi.bench.variants import VARIANTS, Variant, available, base_of
from svu_mi.capture.scene import load_scene
from svu_mi.cli.bench import names
from svu_mi.cli.main import main
from svu_mi.errors import MeshError, OptionError, SceneError, ShapeError, SvuWarning
from svu_mi.metrics import GroundTruth
from svu_mi.posterior import PrincipledGrid
from svu_mi.progress import Progress

TINY = Sizes(views=6, film=32, spp=4, texels=48, speed_texels=48, reference_texels=20,
             reference_spp=4, brute_texels=6, brute_spp=2, checked=1, speed_film=32,
             repeats=1)  # fmt: skip
TWO = (Variant("spectrum paper", "spectrum", "paper", main=True),
       Variant("spectrum default", "spectrum", "default", main=True),
       Variant("spectrum degree 4", "spectrum", "default", {"degree": 4}))  # fmt: skip
CELLS = own_cells(["vase"], ["window"])


def bench_in(folder, **changes):
    return accuracy.Bench(folder, TINY, Progress(), **changes)


@pytest.fixture
def calls(monkeypatch):
    """How often the expensive steps run: rendering, reference, estimates."""
    counts = {"render": 0, "reference": 0, "estimate": 0}

    def counted(name, function):
        def call(*arguments, **options):
            counts[name] += 1
            return function(*arguments, **options)

        return call

    from svu_mi.bench import captures

    monkeypatch.setattr(captures, "render_capture", counted("render", captures.render_capture))
    monkeypatch.setattr(accuracy, "estimate", counted("estimate", accuracy.estimate))
    trace = counted("reference", accuracy.reference_posterior)
    return counts, trace


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A benchmark of one cell: its folder and record."""
    folder = tmp_path_factory.mktemp("bench")
    return folder, run_bench(bench_in(folder), CELLS, "accuracy", variants=TWO, command="svu b")


# --- end to end ---------------------------------------------------------------------------


def test_a_benchmark_writes_figures_tables_and_plots(finished):
    folder, record = finished
    assert {path.name for path in folder.glob("*.*")} == {
        "bench.json", "bench.md", "time_error.png", "scatter.png", "sparsification.png",
        "switches.png",
    }  # fmt: skip
    written = json.loads((folder / "bench.json").read_text())
    assert written["command"] == "svu b"
    assert written["environment"]["versions"]["mitsuba"] == mi.__version__
    assert written["summary"] == record["summary"]
    text = (folder / "bench.md").read_text()
    for word in ("spectrum paper", "brightness", "number of views", "vase / window", "90%"):
        assert word in text
    with Image.open(folder / "time_error.png") as picture:
        assert picture.width > 600


def test_every_figure_is_there_and_in_its_range(finished):
    _, record = finished
    (cell,) = record["cells"]
    assert list(cell["variants"]) == [variant.label for variant in TWO]
    for label, found in cell["variants"].items():
        paper = label == "spectrum paper"
        assert -1 <= found["pearson"] <= 1
        assert -1 <= found["spearman"] <= 1
        assert 0 <= found["mean_entropy"] <= 1
        assert found["seconds"] == pytest.approx(sum(found["timings"].values()))
        assert set(found["credible"]) == {"0.5", "0.9"}
        assert found["credible"]["0.5"]["plain"] <= found["credible"]["0.9"]["plain"]
        others = ["specular"] if paper else ["metallic", "base_color"]
        assert list(found["parameters"]) == ["roughness", *others]
        assert len(found["entropy"]) == cell["reference"]["texels"]
    assert 0 < cell["reference"]["half_overlap"] < 1
    assert list(cell["reference"]["parameters"]) == ["roughness", "metallic", "base_color"]
    kinds = [row["kind"] for row in record["summary"]]
    assert kinds == ["main", "main", "switch", "sanity", "sanity", "reference"]


def test_a_second_run_computes_nothing(finished, calls):
    folder, record = finished
    counts, trace = calls
    again = run_bench(bench_in(folder, trace=trace), CELLS, "accuracy", variants=TWO)
    assert counts == {"render": 0, "reference": 0, "estimate": 0}
    assert again["cells"] == record["cells"]


def test_a_new_variant_is_all_that_is_computed(finished, calls):
    folder, record = finished
    counts, trace = calls
    more = (*TWO, Variant("spectrum degree 5", "spectrum", "default", {"degree": 5}))
    found = run_bench(bench_in(folder, trace=trace), CELLS, "accuracy", variants=more)
    assert counts["render"] == 0
    assert 1 <= counts["estimate"] <= 2  # twice when its kernels were compiled
    assert len(found["cells"][0]["variants"]) == 4
    old = record["cells"][0]["variants"]["spectrum paper"]
    assert found["cells"][0]["variants"]["spectrum paper"] == old


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path, calls, monkeypatch):
    """Interrupted in the second cell: the first is not touched again, the second is finished."""
    counts, trace = calls
    cells = own_cells(["vase"], ["window", "overcast"])
    interrupted = []

    def failing(*arguments, **options):
        interrupted.append(1)
        if len(interrupted) == 2:
            raise KeyboardInterrupt
        return trace(*arguments, **options)

    with pytest.raises(KeyboardInterrupt):
        run_bench(bench_in(tmp_path, trace=failing), cells, "accuracy", variants=TWO[:1])
    assert not (tmp_path / "bench.json").exists()
    assert counts["render"] == 2
    record = run_bench(bench_in(tmp_path, trace=trace), cells, "accuracy", variants=TWO[:1])
    assert counts["render"] == 2
    assert counts["reference"] == 2
    assert [cell["light"] for cell in record["cells"]] == ["window", "overcast"]


def test_a_cell_that_cannot_run_is_reported_and_left_out(finished, tmp_path):
    folder, _ = finished
    bad = replace(CELLS[0], object="broken", scene=tmp_path / "none.xml")
    with pytest.warns(SvuWarning, match="broken / window is left out"):
        record = run_bench(bench_in(folder), (bad, *CELLS), "accuracy", variants=TWO)
    assert [failed["cell"] for failed in record["failed"]] == ["broken / window"]
    assert len(record["cells"]) == 1
    assert "none.xml" in (folder / "bench.md").read_text()
    with pytest.raises(SceneError), pytest.warns(SvuWarning):
        run_bench(bench_in(tmp_path), (bad,), "accuracy", variants=TWO)


@pytest.mark.slow
def test_run_times_of_one_cell(finished, monkeypatch):
    """Every part of ``speed``, with short curves; the cold run is a real new process."""
    folder, _ = finished
    for name, short in (("DEGREES", (2, 4)), ("NODES", (4,)), ("VIEWS", (3, 10)),
                        ("SAMPLES", (2, 4, 8))):  # fmt: skip
        monkeypatch.setattr(speed, name, short)

    def trace(*arguments, **options):
        if options.get("method") == "brute":
            options["grid"] = PrincipledGrid(2, 2, 2)
        return accuracy.reference_posterior(*arguments, **options)

    one = TWO[1:2]
    bench = bench_in(folder, trace=trace)
    (checked,) = run_bench(bench, CELLS, "checks", variants=one)["checks"]
    cases = checked["estimators"]["spectrum default"]
    assert list(cases) == ["direct", "photographs", "both", "heteroscedastic", "estimated"]
    assert all(-1 <= rho <= 1 for rho in (*cases.values(), checked["references"]))
    text = (folder / "bench.md").read_text()
    assert "noise grows with radiance" in text and "noise is estimated" in text
    record = run_bench(bench, CELLS, "speed", variants=one)
    found = record["speed"]
    timed = found["estimators"]["variants"]
    assert list(timed) == ["spectrum default"]
    for times in timed.values():
        assert times["cold"]["kernels"] > 3
        assert list(times["warm"]) == list(times["cold"]["timings"])
        assert times["cold"]["process_seconds"] > times["cold"]["seconds"] > 0
    curves = found["scaling"]
    assert [row["value"] for row in curves["degree"]["spectrum default"]] == [2, 4]
    assert [row["value"] for row in curves["views"]["spectrum default"]] == [3, 6]
    assert [row["value"] for row in curves["reference_spp"]["reference"]] == [2, 4]
    brute = found["brute"]
    assert brute["psi"] == 512
    assert brute["sample_rays"] % (8 * brute["spp"]) == 0
    assert brute["seconds"] == pytest.approx(16 * brute["linear_seconds"])
    assert brute["seconds"] > brute["sample_seconds"]
    assert {"scaling.png", "time_error.png"} <= {path.name for path in folder.iterdir()}
    assert "(extrapolated)" in (folder / "bench.md").read_text()


# --- what is run --------------------------------------------------------------------------


def test_the_cells_of_svu_mi():
    assert len(own_cells()) == 12
    assert [cell.name for cell in own_cells(quick=True)] == [
        "vase__window", "vase__overcast", "knot__window", "knot__overcast"
    ]  # fmt: skip
    assert own_cells(["planes"], ["clear"])[0].defines == {"light": "clear", "max_depth": "2"}
    with pytest.raises(OptionError, match="no object 'teapot'; there are planes"):
        own_cells(["teapot"])
    with pytest.raises(OptionError, match="no light 'moon'"):
        own_cells(lights=["moon"])


def test_names_of_the_command_line():
    assert names("", "--objects") == ()
    assert names("vase, knot", "--objects") == ("vase", "knot")
    with pytest.raises(OptionError, match="--objects"):
        names("vase,,knot", "--objects")


def test_variants_have_unique_labels_and_a_default_to_compare_with():
    labels = [variant.label for variant in VARIANTS]
    assert len(set(labels)) == len(labels)
    known = available()
    assert {v.label for v in known} >= {"spectrum paper", "spectrum default"}
    assert known == VARIANTS  # all of them, in this version
    presets = {variant.label: variant.preset for variant in known}
    for variant in known:
        assert f"{variant.method} default" in labels
        assert variant.main or variant.preset != presets[base_of(variant.label, labels)]
    assert base_of("angular fixed, looked up, Fresnel: none", labels) == "angular fixed, looked up"
    assert base_of("angular fixed, Lambert", labels) == "angular fixed"
    assert base_of("spectrum degree 4", labels) == "spectrum default"


def test_what_run_bench_refuses(tmp_path):
    with pytest.raises(OptionError, match="no benchmark 'power'; there are accuracy"):
        run_bench(bench_in(tmp_path), CELLS, "power")
    with pytest.raises(OptionError, match="no object under any light"):
        run_bench(bench_in(tmp_path), ())


@pytest.mark.parametrize("what", ["kernels", "conventions", "orb"])
def test_what_left_the_package_is_told_where_it_is(what, tmp_path, capsys, variant):
    assert main(["bench", what, "-o", str(tmp_path / "o")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"svu bench {what} is no longer part of svu" in line
    assert line.endswith(f"run PYTHONPATH=tests python -m studies.{what}.")
    assert not (tmp_path / "o").exists()


def test_an_unknown_benchmark_is_one_line(tmp_path, capsys, variant):
    assert main(["bench", "power", "-o", str(tmp_path)]) == 2
    assert "no benchmark 'power'; there are accuracy, checks" in capsys.readouterr().err


def test_views_are_left_out_evenly(finished):
    folder, _ = finished
    whole = bench_in(folder).capture(CELLS[0])
    half = some_views(whole, 3)
    assert half.names == ("view_0000.exr", "view_0002.exr", "view_0005.exr")
    assert len(half.images) == len(half.masks) == half.count == 3
    assert some_views(whole, 6).names == whole.names


def test_photographs_with_other_settings_are_rendered_anew(tmp_path, calls):
    counts, _ = calls
    small = replace(TINY, views=2, film=8, spp=1)
    for settings, rendered in ((small, 1), (small, 1), (replace(small, spp=2), 2)):
        capture_of(CELLS[0], settings, tmp_path / "capture", Progress())
        assert counts["render"] == rendered
    (tmp_path / "capture" / "bench.json").write_text("{")  # a broken mark is no mark
    capture_of(CELLS[0], replace(small, spp=2), tmp_path / "capture", Progress())
    assert counts["render"] == 3


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
    """What Mitsuba's scene of the folder has at UVs."""
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


def test_factors_without_textures(tmp_path):
    """Colour factors are linear light: 0.2 stays 0.2 through the sRGB file."""
    path = box(tmp_path, baseColorFactor=[51, 102, 255, 255], roughnessFactor=0.25,
               metallicFactor=0.75)  # fmt: skip
    color, rough, metal, _ = parameters_at(convert_glb(path, tmp_path / "c"), [[0.3, 0.6]] * 2)
    np.testing.assert_allclose(color[0], [0.2, 0.4, 1], atol=4e-3)
    np.testing.assert_allclose(rough, 0.25, atol=3e-3)
    np.testing.assert_allclose(metal, 0.75, atol=3e-3)


def test_glb_files_that_are_refused(tmp_path):
    (tmp_path / "bad.glb").write_bytes(b"not a GLB")
    with pytest.raises(MeshError, match="bad.glb: not a readable mesh"):
        convert_glb(tmp_path / "bad.glb", tmp_path / "c")
    trimesh.creation.box().export(tmp_path / "plain.glb")
    with pytest.raises(MeshError, match="plain.glb: a mesh has no UVs"):
        convert_glb(tmp_path / "plain.glb", tmp_path / "c")
    scene = trimesh.Scene()
    for factor in (0.25, 0.5):
        box(tmp_path, "part.glb", roughnessFactor=factor)
        scene.add_geometry(next(iter(trimesh.load_scene(tmp_path / "part.glb").geometry.values())))
    scene.export(tmp_path / "two.glb")
    with pytest.raises(MeshError, match="two.glb: has not one material"):
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
    cells = data_cells(data, tmp_path / "work")
    assert [cell.title for cell in cells] == [
        "cup / room", "cup / sky", "thing / room", "thing / sky"
    ]  # fmt: skip
    assert cells[1].defines["environment"].endswith("sky.exr")  # before Radiance
    assert (tmp_path / "work" / "objects" / "thing" / "roughness.png").is_file()
    (only,) = data_cells(data, tmp_path / "work", ["cup"], ["sky"])
    assert Path(only.defines["object"]) == (data / "objects" / "cup").resolve()
    with pytest.raises(OptionError, match="'jug'; there are cup, thing"):
        data_cells(data, tmp_path / "work", ["jug"])
    (data / "objects" / "cup" / "metallic.png").unlink()
    with pytest.raises(OptionError, match="cup: an object's folder needs .* no metallic.png"):
        data_cells(data, tmp_path / "work")


def test_bad_folders_end_with_one_line_and_status_2(tmp_path, capsys, variant):
    def words(data):
        assert main(["bench", "accuracy", "--data", str(data), "-o", str(tmp_path / "o")]) == 2
        return capsys.readouterr().err

    assert "objects: no such folder; --data needs one with objects" in words(tmp_path / "none")
    (tmp_path / "objects").mkdir()
    assert "objects: holds no object" in words(tmp_path)
    box(tmp_path / "objects", roughnessFactor=0.5)
    assert "envmaps: no such folder; --data needs one with lat-long images" in words(tmp_path)
    (tmp_path / "envmaps").mkdir()
    assert "envmaps: holds no lat-long image" in words(tmp_path)
    mi.set_log_level(mi.LogLevel.Warn)


# --- parts --------------------------------------------------------------------------------


def test_a_record_counts_only_under_its_key(tmp_path):
    store = Store(tmp_path / "store")
    key = key_of({"a": 1}, (2, 3))
    assert key == key_of({"a": 1}, [2, 3]) != key_of({"a": 2}, [2, 3])
    assert store.load("x", key) is None
    assert store.save("x", key, {"value": np.float32(0.5)}) == {"value": 0.5, "key": key}
    assert store.load("x", key) == {"value": 0.5, "key": key}
    assert store.load("x", "other") is None
    store.path("x").write_text('{"value": 0.')
    assert store.load("x", key) is None
    store.path("x").write_text("[]")
    assert store.load("x", key) is None


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
    found = judge_posterior(p, axes, truth, rng.random(30), kept)
    assert found["credible"]["0.5"]["plain"] == 1
    assert all(figures["rmse"] == 0 for figures in found["parameters"].values())
    assert found["ause"] == 0
    grey = judge_posterior(np.eye(5)[pick[0]], {"roughness": nodes}, truth, rng.random(30), kept)
    assert grey["parameters"]["roughness"]["mae"] == 0
    with pytest.raises(ShapeError, match="do not fit a grid of"):
        judge_posterior(p[:, :4], axes, truth, rng.random(30), kept)


def test_text():
    assert [seconds(t) for t in (0.0123, 1.26, 45.2, 300, 9000, 4e5)] == [
        "0.012 s", "1.3 s", "45.2 s", "5 min", "2.5 h", "4.63 d"
    ]  # fmt: skip
    assert table(("a", "b"), [[1, "x|y"]]) == "| a | b |\n| --- | --- |\n| 1 | x\\|y |"


def test_quick_is_smaller_than_full():
    assert all(getattr(QUICK, name) <= getattr(Sizes(), name)
               for name in ("views", "film", "spp", "texels", "reference_texels"))  # fmt: skip
