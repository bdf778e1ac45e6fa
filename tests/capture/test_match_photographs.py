"""What is not there, or is of another kind, is counted, named, and the way out is told."""

from __future__ import annotations

import inspect
import json
import os
import pickle
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from support.helpers import run, sensor_xml, write_scene

import svu_mi as svu
from svu_mi import pipeline
from svu_mi.capture.match_photographs import match_photographs
from svu_mi.capture.scene import find_environment, load_scene
from svu_mi.core.io.exr import write_exr
from svu_mi.errors import CaptureError, OptionError, SceneError, SvuEnvironmentError, excerpt
from svu_mi.posterior.row_entropy import log_prior

pytestmark = pytest.mark.usefixtures("variant")
SENSORS = 8


@pytest.fixture
def nerf(tmp_path) -> Path:
    """Photographs as Blender's add-ons write them: no sizes, names without suffixes."""
    folder = tmp_path / "nerf"
    (folder / "shots").mkdir(parents=True)
    frames = []
    for number in range(4):
        write_exr(folder / "shots" / f"DSC_{number}.exr", {"RGB": np.full((24, 32, 3), 0.5)})
        pose = np.eye(4)
        pose[:3, 3] = (0.2 * number, 0, 4)
        frames.append({"file_path": f"shots/DSC_{number}", "transform_matrix": pose.tolist()})
    record = {"camera_angle_x": 0.7, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(record))
    trimesh.creation.icosphere(subdivisions=2).export(folder / "ball.ply")
    write_exr(folder / "probe.exr", {"RGB": np.ones((8, 16, 3))})
    return folder


def words(nerf: Path, *more: object) -> list[object]:
    light = [] if "--environment" in more else ["--environment", nerf / "probe.exr"]
    out = nerf.parent / "capture"
    return ["import", nerf, "--mesh", nerf / "ball.ply", *light, *more, "-o", out]


def test_a_missing_photograph_has_the_suffix_of_the_others(tmp_path):
    for name in ("a", "c"):
        (tmp_path / f"{name}.png").touch()
    with pytest.raises(CaptureError, match=r"1 of 3 photographs is missing, first b\.png; add"):
        match_photographs(tmp_path, ["a", "b", "c"])
    with pytest.raises(CaptureError, match=r"a\.png: is a file; give the folder"):
        match_photographs(tmp_path / "a.png", ["a"])


def test_ids_of_all_sensors_go_before_numbers(tmp_path):
    """Regression: of cam0, cam1 and an included view_0002, only the last one was used."""
    ids = ["cam0", "cam1", "view_0002", "view_0000"]
    for name in ids:
        (tmp_path / f"{name}.png").touch()
    assert match_photographs(tmp_path, ids).names == [f"{name}.png" for name in ids]


def test_keys_of_a_dictionary_name_sensors_and_shape(tmp_path):
    """``write_file`` writes them as names; the order of files differs from that of the sensors."""
    keys = ("left", "front", "back")
    sensors = {key: {"type": "perspective", "fov": 20.0 + k} for k, key in enumerate(keys)}
    config = mi.parser.ParserConfig(mi.variant())
    scene = {"type": "scene", **sensors, "ball": {"type": "sphere"}, "other": {"type": "sphere"}}
    path = tmp_path / "scene.xml"
    mi.parser.write_file(mi.parser.parse_dict(config, scene), str(path))
    loaded = load_scene(path)
    assert [shape.id() for shape in loaded.shapes()] == ["ball", "other"]
    ids = [sensor.id() for sensor in loaded.sensors()]
    for name in keys:
        (tmp_path / f"{name}.exr").touch()
    assert [path.stem for path in match_photographs(tmp_path, ids).paths] == list(keys)


def test_missing_photographs_of_an_import_are_counted(nerf, capsys):
    (nerf / "shots" / "DSC_2.exr").unlink()
    (nerf / "shots" / "DSC_3.exr").unlink()
    assert run(*words(nerf)) == 2
    lack = f"{nerf}: 2 of 4 photographs are missing, first shots/DSC_2"
    assert capsys.readouterr().err == (
        f"svu: {lack}; add them, or continue without them by --missing leave-out.\n"
    )
    assert run(*words(nerf, "--missing", "leave-out")) == 0
    assert f"{lack}; ignored." in capsys.readouterr().out.splitlines()
    assert svu.load_capture(nerf.parent / "capture").count == 2


def test_four_photographs_of_unknown_light_are_enough_to_estimate_it(nerf, capsys):
    out = nerf.parent / "capture"
    assert run("import", nerf, "--mesh", nerf / "ball.ply", "-o", out) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == f"Then estimate its light with: svu light {out}"


def test_without_any_photograph_nothing_is_imported(nerf, capsys):
    for file in (nerf / "shots").iterdir():
        file.unlink()
    for more in ((), ("--missing", "leave-out")):
        assert run(*words(nerf, *more)) == 2
        assert capsys.readouterr().err == (
            f"svu: {nerf}/transforms.json: 4 of 4 photographs are missing, first shots/DSC_0; move "
            "them to the paths in the poses.\n"
        )


def test_a_missing_light_is_no_photograph(nerf, capsys):
    assert run(*words(nerf, "--environment", nerf / "probe.hdr")) == 2
    assert capsys.readouterr().err == (
        f"svu: {nerf}/probe.hdr: no such environment map; give an HDR or EXR map with "
        "--environment.\n"
    )


@pytest.mark.parametrize(("place", "files", "instead"), [
    ("raw", [f"IMG_{k}.BMP" for k in range(8)], "the folder has no image in a supported format "
     "(8 .BMP: convert them to EXR, or to PNG, first)"),
    ("raw", [], "the folder has no image: give another one with --images, or save the photographs "
     "there"),
    (".", ["IMG_1.exr"], "no image there has such a name: put the photographs into a separate "
     "folder and give it with --images"),  # where textures may lie, too
])  # fmt: skip
def test_error_names_content_of_folder_without_photographs(tmp_path, capsys, place, files, instead):
    path, raw = write_scene(tmp_path, sensors=sensor_xml(SENSORS)), tmp_path / place
    raw.mkdir(exist_ok=True)
    for name in files:
        (raw / name).touch()
    assert run("entropy", path, "--images", raw, "-o", tmp_path / "out") == 2
    assert capsys.readouterr().err == (
        f"svu: {raw}: 8 of 8 photographs are missing, first cam0.exr; {instead}.\n"
    )


def test_missing_photographs_of_any_name_are_refused(tmp_path):
    path, folder = write_scene(tmp_path, sensors=sensor_xml(SENSORS)), tmp_path / "mine"
    folder.mkdir()
    for number in range(SENSORS - 1):
        write_exr(folder / f"IMG_{number}.exr", {"RGB": np.ones((24, 24, 3))})
    lack = f"{folder}: 7 photographs for 8 sensors cannot be assigned by their names; "
    names = "name them view_0000, ... by the index of their sensor, or by its id"
    with pytest.raises(CaptureError) as caught:
        svu.load_capture(path, folder)
    assert str(caught.value) == f"{lack}{names}, or give one per sensor."
    with pytest.raises(CaptureError) as caught:
        svu.load_capture(path, folder, missing="leave-out")
    assert str(caught.value) == f"{lack}{names}."


def test_reason_of_mitsuba_is_reported_once(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0">\n<default name="light" value="window"/>\n'
        '<include filename="$light.xml"/>\n</scene>'
    )
    with pytest.raises(SceneError) as caught:
        load_scene(path, {"light": "windw"})
    assert str(caught.value) == f'{path}: line 3: included file "windw.xml" not found.'
    (tmp_path / "window.xml").write_text('<scene version="3.0.0">\n<flot/>\n</scene>')
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert str(caught.value) == (
        f"{path}: window.xml, line 2: encountered an unsupported XML element: <flot>."
    )


def test_a_lamp_without_an_id_is_an_area_light():
    lamp = mi.load_dict(
        {"type": "scene", "lamp": {"type": "rectangle", "id": "", "emitter": {"type": "area"}}}
    )
    with pytest.raises(SceneError, match=r"^lamp: an area light \(AreaLight\) is not supported"):
        find_environment(lamp, "lamp")


def test_a_mistaken_argument_is_named(tmp_path):
    scene = mi.load_file(str(write_scene(tmp_path)))
    for call, sentence in (
        (lambda: svu.texels("ball.ply", 64),
         "texels(): mesh must be a mesh or a capture, got a str; use capture.mesh."),
        (lambda: svu.Candidates.around("capture", 5), "Candidates.around(): capture must be a "
         "Capture, got 'capture'; use svu.load_capture(path)."),
        (lambda: svu.load_capture(scene),
         f"load_capture(): path must be a str or a Path, got {excerpt(scene, 60)}."),
    ):  # fmt: skip
        with pytest.raises(OptionError) as caught:
            call()
        assert str(caught.value) == sentence


def test_another_variant_is_named_before_any_work(variant, vase):
    mi.set_variant("scalar_rgb")
    try:
        for call in (svu.estimate, svu.texels):
            with pytest.raises(SvuEnvironmentError, match="Variant 'scalar_rgb' is not supported"):
                call(vase.capture)
    finally:
        mi.set_variant(variant)


@pytest.mark.forks
def test_a_fork_is_refused(variant):
    """Dr.Jit would wait for ever for its threads, which only the first process has."""
    if (pid := os.fork()) == 0:
        try:
            mi.set_variant(variant)
            svu.load_capture("capture")
        except SvuEnvironmentError as error:
            os._exit(7 if "multiprocessing.get_context('spawn')" in str(error) else 1)
        finally:
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7


def test_version_and_several_values(capsys):
    from svu_mi.cli.shared_options import repeat_known

    assert run("--version") == 0
    assert capsys.readouterr().out == f"svu {svu.__version__}\n"
    given = ["entropy", "--known", "metallic=0", "roughness=0.5", "a=b.xml", "--known", "scene"]
    assert repeat_known(given) == [
        "entropy", "--known", "metallic=0", "--known", "roughness=0.5", "a=b.xml",
        "--known", "scene",
    ]  # fmt: skip
    command = ["entropy", "none.xml", "--known", "metallic=0", "roughness=2"]
    assert run(*command) == 2
    assert "Unrecognized" not in capsys.readouterr().err


@pytest.mark.slow
def test_repr_describes_the_object(tmp_path):
    """A notebook shows the last value of each cell."""
    path = write_scene(tmp_path)
    capture = svu.render_capture(path, spp=4, folder=tmp_path / "shot")
    texels = svu.texels(capture, 16)
    assert repr(capture) == (
        "<Capture ball: 3 photographs of 24 x 24, light ConstantBackgroundEmitter, from "
        f"{tmp_path}/shot>"
    )
    assert repr(texels) == f"<Texels: {texels.count} on the surface, of 16 x 16>"
    estimate = svu.estimate(capture, texels)
    seen = (np.array(estimate.coverage) > 0).mean()
    assert repr(estimate) == (
        f"<Estimate angular: mean entropy {np.array(estimate.entropy).mean():.2f} of "
        f"{texels.count} texels, {seen:.0%} seen in 3 photographs>"
    )
    guidance = svu.next_best_view(estimate, svu.Candidates.around(capture, 4))
    assert repr(guidance) == (
        f"<Guidance: {guidance.proposals[0].name} of 4 candidates, mean entropy "
        f"{guidance.entropy:.2f} so far>"
    )
    check = svu.check(capture)
    assert repr(check).splitlines()[0] == "<Check of 3 photographs"
    assert all(finding.sentence in repr(check) for finding in check.findings)
    recovery = svu.recover(estimate, method="sh")
    assert repr(recovery).startswith(f"<Recovery sh: textures of 16 x 16, {texels.count} texels, ")


@pytest.mark.parametrize(
    "prior", ["uniform", [[1, 2], [3]], {"roughness": 1}, object(), 1j * np.ones(8), [None] * 8]
)
def test_invalid_prior_is_refused(prior):
    kind = type(prior).__name__
    with pytest.raises(OptionError) as error:
        log_prior(prior, (8, 8, 8), "estimate()")
    assert str(error.value) == (
        f"estimate(): the prior must be numbers, (8, 8, 8) or (8,), got a {kind}."
    )


def test_arguments_of_wrong_type_are_refused(vase):
    """Public functions check their annotations, and say how to make an argument."""
    capture, mesh = vase.capture, vase.capture.mesh
    for call, sentence in (
        (lambda: svu.check("cap"), "check(): capture must be a Capture, got 'cap'; use "
         "svu.load_capture(path)."),
        (lambda: svu.estimate(capture, 96), "estimate(): texels must be a Texels, got 96; use "
         "svu.texels(capture, resolution)."),
        (lambda: svu.estimate(vase.estimate, method="best"),
         "estimate(): method must be one of angular, spectrum, got 'best'."),
        (lambda: svu.next_best_view("cap"), "next_best_view(): estimate must be an Estimate, got "
         "'cap'; use svu.estimate(capture, texels)."),
        (lambda: svu.next_best_view(vase.estimate, 100, 5), "next_best_view(): candidates must be "
         "a Candidates or a list, got 100; use svu.Candidates.around(capture)."),
        (lambda: svu.import_capture("cap", "out", "mesh.obj"),
         "import_capture(): source must be a Source, got 'cap'; use svu.read_source(path)."),
        (lambda: svu.ImportOptions(mesh="a.obj", environment="b.exr"), "ImportOptions: environment "
         "must be a Light, got 'b.exr'; use svu.Light(path=path)."),
        (lambda: svu.recover(vase.estimate, parameters="roughness"),
         "recover(): parameters must be a list, got 'roughness'."),
        (lambda: svu.render_capture("a.xml", spq=3), "render_capture(): got an unexpected keyword "
         f"argument 'spq'; it has {', '.join(inspect.signature(svu.render_capture).parameters)}."),
        (lambda: svu.load_capture({"type": "scene"}), "load_capture(): path must be a str or a "
         "Path, got {'type': 'scene'}; write a scene to a file with mi.parser.write_file."),
        (lambda: svu.render_capture("a.xml", True),
         "render_capture(): spp must be a whole number, got True."),
        (lambda: svu.TotalVariation(64, mesh), "TotalVariation: texels must be a Texels, got 64; "
         "use svu.texels(capture, resolution)."),
        (lambda: vase.estimate.posterior.interval("roughness", "0.9"),
         "Posterior.interval(): level must be in (0, 1), got '0.9'."),
        (lambda: svu.Candidates.at(capture, 3), "Candidates.at(): views must be a list, got 3."),
        (lambda: vase.estimate.posterior.prior_moments("gloss"), "Posterior: unknown parameter "
         "'gloss'; use roughness or metallic or base_color."),
        (lambda: vase.texels.subset([-1]), "Texels.subset(): no texel -1; texels are numbered from "
         f"0 to {vase.texels.count - 1}."),
        (lambda: svu.TotalVariation(vase.texels, mesh)(None), "TotalVariation: expected a texture "
         "as mi.TensorXf, got NoneType; wrap it in mi.TensorXf."),
        (lambda: pickle.dumps(vase.estimate),
         "A Mitsuba scene cannot be pickled or copied; load the capture again."),
        (lambda: vase.estimate.posterior.map([0.5]),
         "Posterior: no texel 0.5; texels are numbered from 0 to "
         f"{vase.texels.count - 1}."),
    ):  # fmt: skip
        with pytest.raises(OptionError) as caught:
            call()
        assert str(caught.value) == sentence


def test_a_warning_names_the_line_of_the_caller(vase):
    with pytest.warns(svu.SvuWarning, match="^Dust.$") as caught:
        vase.capture.warned("Dust.")
    assert caught[0].filename == __file__


def test_public_functions_take_numbers_and_lists_of_numpy(vase):
    """NumPy scalars are numbers, lists are arrays, and functions can be pickled."""
    assert svu.preset("default", cells=np.int64(512), metals=np.float32(0.5)).cells == 512
    grid = svu.texels(vase.capture, np.array([16, 8]))
    assert grid.resolution == (16, 8)
    assert pickle.loads(pickle.dumps(svu.estimate)) is svu.estimate
    assert inspect.signature(svu.estimate) == inspect.signature(pipeline.estimate)
