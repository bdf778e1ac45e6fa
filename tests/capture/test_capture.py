"""Captures: what goes into a folder comes out again, and bad input says what to do."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.helpers import ball, fails, names, run, sensor_xml, write_scene

import svu_mi as svu
from svu_mi.capture import rendering
from svu_mi.capture.image_io import open_image
from svu_mi.capture.load_warnings import unsupported
from svu_mi.capture.loading import load_capture
from svu_mi.capture.match_photographs import NoPhotographsError
from svu_mi.capture.mesh import arrays, make_mesh
from svu_mi.capture.rendering import render_capture
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.sensors import describe, make_sensor, sphere_sensors
from svu_mi.capture.unwrap import unwrap
from svu_mi.core.io.exr import read_exr, read_header, write_exr
from svu_mi.core.io.folder_exchange import DRAFT, beside
from svu_mi.core.io.provenance import RUN
from svu_mi.errors import (
    CaptureError,
    OptionError,
    OutputError,
    SceneError,
    SvuEnvironmentError,
    SvuWarning,
)
from svu_mi.evaluation.ground_truth import ground_truth
from svu_mi.geometry.texels import texels
from svu_mi.pipeline import estimate


def write_images(folder, count, shape=(24, 24), value=0.5):
    """Write ``count`` grey photographs."""
    folder.mkdir(exist_ok=True)
    for index in range(count):
        write_exr(folder / f"view_{index:04d}.exr", {"RGB": np.full((*shape, 3), value)})
    return folder


def photographed(folder, **changes):
    """A scene with three sensors and its three photographs."""
    write_images(folder / "images", 3)
    return write_scene(folder, **changes)


@pytest.fixture
def scene(tmp_path):
    return photographed(tmp_path)


# --- what goes in comes out -----------------------------------------------------------------


def test_rendered_folder_is_loaded_without_change(tmp_path):
    path = write_scene(tmp_path)
    first = render_capture(path, spp=4, seed=831, folder=tmp_path / "shot", views=4,
                           resolution=(20, 12))  # fmt: skip
    again = load_capture(tmp_path / "shot")
    assert first.count == again.count == 4
    for a, b in zip(first.images, again.images, strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.shape == (12, 20, 3)
    for a, b in zip(first.sensors, again.sensors, strict=True):
        assert describe(a) == describe(b)
    for mask in again.masks:
        assert 0.1 < mask.mean() < 0.9
        assert not mask[0, 0]


def test_a_capture_is_rendered_with_a_view_added(tmp_path):
    words = {"folder": tmp_path / "shot", "views": 3, "resolution": (20, 12)}
    first = render_capture(write_scene(tmp_path), spp=4, **words)
    record = json.loads((tmp_path / "shot" / "capture.json").read_text())
    record["sensors"].append({**record["sensors"][0], "x_fov": 50})
    (tmp_path / "shot" / "capture.json").write_text(json.dumps(record))
    more = render_capture(tmp_path / "shot", spp=4, folder=tmp_path / "more")
    assert more.count == 4 and describe(more.sensors[3])["x_fov"] == pytest.approx(50)
    np.testing.assert_array_equal(more.images[2], first.images[2])
    record["flash"] = {"position": [0, 0, 0], "intensity": [1, 1, 1]}
    (tmp_path / "shot" / "capture.json").write_text(json.dumps(record))
    with pytest.raises(SceneError, match="lamp on its camera"):
        render_capture(tmp_path / "shot")
    record["import"] = {"format": "colmap"}
    (tmp_path / "shot" / "capture.json").write_text(json.dumps(record))
    with pytest.raises(SceneError, match="is imported; give a Mitsuba scene"):
        render_capture(tmp_path / "shot")


def test_renders_with_one_seed_are_equal_and_views_differ(tmp_path):
    path = write_scene(tmp_path)

    def image(seed):
        """Without its scene: beside one that is alive, another takes a kernel of its own."""
        capture = render_capture(path, spp=2, seed=seed)
        assert capture.source is None  # in memory alone
        return capture.images[1]

    a, b, other = image(99), image(99), image(100)
    # Threads add up in any order: equal to rounding.
    np.testing.assert_allclose(a, b, rtol=1e-5)
    assert np.abs(a - other).max() > 1e-2


def test_a_live_scene_can_be_rendered(tmp_path):
    scene = mi.load_file(str(write_scene(tmp_path)), optimize=False)
    capture = render_capture(scene, spp=2, folder=tmp_path / "shot")
    assert capture.count == 3
    with pytest.raises(CaptureError, match="neither a Mitsuba XML scene.* svu import first"):
        load_capture(tmp_path / "shot")  # the folder cannot know a scene that was never a file


def test_exposure_is_divided_out(scene):
    folder = scene.parent / "images"
    record = {"format": "svu-capture", "exposure": [1, 2, 4]}
    (folder / "capture.json").write_text(json.dumps(record))
    capture = load_capture(scene)
    assert [float(image.mean()) for image in capture.images] == [0.5, 0.25, 0.125]


@pytest.mark.parametrize("gain", [0.0, -1.0, float("nan"), 1e-40, 10**400])
def test_the_first_exposure_out_of_range_is_named(scene, gain):
    folder, gains = scene.parent / "images", [1, gain, 0]
    message = rf"exposure\[1\] must be a number in \[1e-30, 1e\+30\], got {str(gain)[:40]}"
    (folder / "capture.json").write_text(json.dumps({"format": "svu-capture", "exposure": gains}))
    with pytest.raises(CaptureError, match=message):
        load_capture(scene)


def test_sensors_survive_their_description(tmp_path):
    target = mi.load_dict({"type": "sphere"})
    record = {**describe(sphere_sensors(target, 3, (40, 30))[1]), "crop_offset": [3, 4],
              "crop_size": [20, 10], "principal_point_offset": [0.125, -0.25]}  # fmt: skip
    again = describe(make_sensor(record, "odd"))
    assert again.keys() == record.keys()
    for key, value in record.items():
        np.testing.assert_allclose(again[key], value, atol=1e-6, err_msg=key)


def test_alpha_and_mask_files_are_masks(scene):
    folder = scene.parent / "images"
    rgba = np.ones((24, 24, 4), np.float32)
    rgba[:, :5, 3] = 0
    write_exr(folder / "view_0000.exr", {"RGBA": rgba})
    write_exr(folder / "mask_0001.exr", {"Y": rgba[..., 3]})
    capture = load_capture(scene)
    assert not capture.masks[0][:, :5].any()
    assert capture.masks[0][:, 5:].all()
    np.testing.assert_array_equal(capture.masks[0], capture.masks[1])
    assert capture.masks[2] is None
    write_exr(folder / "view_0000.exr", {"RGBA": np.ones((24, 24, 4), np.float32)})
    assert load_capture(scene).masks[0] is None  # shows its environment


def test_defines_reach_the_scene(tmp_path):
    sensors = '<default name="size" value="24"/>' + sensor_xml(2).replace(
        '<integer name="width" value="24"/><integer name="height" value="24"/>',
        '<integer name="width" value="$size"/><integer name="height" value="$size"/>',
    )
    sensors = sensors.replace('<integer name="width" value="24"/>', "")
    path = write_scene(tmp_path, sensors=sensors)
    write_images(tmp_path / "images", 2, (16, 16))
    assert load_capture(path, defines={"size": "16"}).images[0].shape == (16, 16, 3)
    with pytest.raises(CaptureError, match="24 x 24"):
        load_capture(path)
    with pytest.raises(SceneError, match="scene.xml.*unused"):
        load_capture(path, defines={"colour": "red"})


def test_empty_images_folder_does_not_hide_photographs(tmp_path):
    path = write_scene(tmp_path)
    write_images(tmp_path, 3)
    (tmp_path / "images").mkdir()
    assert load_capture(path).count == 3


def test_a_capture_folder_and_other_images_are_a_capture(tmp_path):
    path = write_scene(tmp_path)
    render_capture(path, spp=1, folder=tmp_path / "shot")
    write_images(tmp_path / "other", 3, value=0.25)
    capture = load_capture(tmp_path / "shot", tmp_path / "other")
    assert float(capture.images[0].mean()) == 0.25


@pytest.fixture
def stopping(monkeypatch):
    """Stops a render before view 2, once; keeps the numbers of the views that are rendered."""
    render, seen = rendering._radiance, []

    def stop(scene, sensor, spp, seed):  # the seed of view k is k
        if seed == 2 and 2 not in seen:
            seen.append(2)
            raise KeyboardInterrupt
        seen.append(seed)
        return render(scene, sensor, spp, seed)

    monkeypatch.setattr(rendering, "_radiance", stop)
    return seen


def interrupt(path, out):
    with pytest.raises(KeyboardInterrupt):
        render_capture(path, spp=1, folder=out, resume=False)


def draft_of(out):
    return beside(out, DRAFT)


def test_an_interrupted_render_is_continued(tmp_path, capsys, stopping, variant):
    """By the photographs that it would have made, and no view is rendered twice."""
    path, out = write_scene(tmp_path, sensors=sensor_xml(4)), tmp_path / "shot"
    words = ("render", path, "--spp", 2, "-o", out)
    assert fails(capsys, *words, "--resume") == (
        f"svu: {out}: no interrupted run to resume; omit --resume."
    )
    assert run(*words) == 130
    assert capsys.readouterr().err == (
        "svu: interrupted; 2 views are kept: continue with the same command and --resume\n"
    )
    assert fails(capsys, *words, "--resume", "--spp", 3) == (
        f"svu: {out}: the interrupted run had other options or another scene; restore these, "
        "or omit --resume to start again."
    )
    del stopping[:-1]
    assert run(*words, "--resume") == 0
    assert stopping == [2, 2, 3]
    whole = render_capture(path, spp=2)
    assert names(out) == ["capture.json"] + [f"view_{k:04d}.exr" for k in range(4)]
    again = load_capture(out)
    for one, other in zip(again.images, whole.images, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)


INTEGRATOR = '<integrator type="path">'
CHANGES = {
    "max_depth": (INTEGRATOR, INTEGRATOR + '<integer name="max_depth" value="2"/>'),
    "hide_emitters": (INTEGRATOR, INTEGRATOR + '<boolean name="hide_emitters" value="true"/>'),
    "integrator": ('"path"', '"direct"'),
    "filter": ("</film>", '<rfilter type="box"/></film>'),
    "sampler": ("</sensor>", '<sampler type="stratified"/></sensor>'),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.usefixtures("stopping")
def test_an_interrupted_render_is_not_mixed_with_another(tmp_path, change):
    """What renders otherwise is something else."""
    path, out = write_scene(tmp_path, sensors=sensor_xml(4)), tmp_path / "shot"
    plain = path.read_text().replace('<integrator type="direct"/>', INTEGRATOR + "</integrator>")
    path.write_text(plain)
    interrupt(path, out)
    assert plain.replace(*change) != plain
    path.write_text(plain.replace(*change))
    with pytest.raises(OutputError, match="had other options or another scene"):
        render_capture(path, spp=1, folder=out, resume=True)
    path.write_text(plain)
    assert render_capture(path, spp=1, folder=out, resume=True).count == 4


def linked(path, foreign):
    path.unlink()
    path.symlink_to(foreign)


UNUSABLE = {
    "a link": linked,
    "cut": lambda path, _: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "of another run": lambda path, foreign: shutil.copy(foreign, path),
    "of another size": lambda path, _: write_exr(
        path, {"RGB": np.ones((8, 8, 3))}, {RUN: read_header(path).attributes[RUN]}
    ),
    "a folder": lambda path, _: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("spoil", UNUSABLE.values(), ids=UNUSABLE)
def test_only_whole_views_of_an_interrupted_render_are_kept(tmp_path, stopping, spoil):
    """Another one is rendered again, and what is no view at all does not get into the capture."""
    path, out = write_scene(tmp_path, sensors=sensor_xml(4)), tmp_path / "shot"
    foreign = tmp_path / "foreign.exr"
    write_exr(foreign, {"RGB": np.ones((24, 24, 3))}, {RUN: "0" * 16})
    interrupt(path, out)
    draft = draft_of(out)
    spoil(draft / "view_0001.exr", foreign)
    (draft / "mask_0000.png").symlink_to(foreign)
    before = foreign.read_bytes()
    del stopping[:-1]
    capture = render_capture(path, spp=1, folder=out, resume=True)
    assert stopping == [2, 1, 2, 3] and foreign.read_bytes() == before
    assert names(out) == ["capture.json"] + [f"view_{k:04d}.exr" for k in range(4)]
    assert not any(file.is_symlink() for file in out.iterdir())
    whole = render_capture(path, spp=1)
    np.testing.assert_allclose(capture.images[1], whole.images[1], rtol=1e-5)


@pytest.mark.usefixtures("stopping")
def test_a_render_that_keeps_nothing_clears_what_was_kept(tmp_path):
    path, out = write_scene(tmp_path, sensors=sensor_xml(4)), tmp_path / "shot"
    interrupt(path, out)
    assert len(names(draft_of(out))) == 2
    render_capture(path, spp=1, folder=out)
    assert names(out) == ["capture.json"] + [f"view_{k:04d}.exr" for k in range(4)]
    assert not draft_of(out).exists()


def test_a_luminance_film_gives_grey_photographs(tmp_path):
    luminance = '<string name="pixel_format" value="luminance"/>'
    sensors = sensor_xml(1).replace('"hdrfilm">', f'"hdrfilm">{luminance}')
    image = render_capture(write_scene(tmp_path, sensors=sensors), spp=2).images[0]
    assert image.shape == (24, 24, 3)
    np.testing.assert_array_equal(image[..., 0], image[..., 2])


def test_noise_in_an_8_bit_mask_does_not_matter(scene):
    pixels = np.full((24, 24), 250, np.uint8)
    pixels[:, :5] = 6
    Image.fromarray(pixels).save(scene.parent / "images" / "mask_0000.png")
    mask = load_capture(scene).masks[0]
    assert mask[:, 5:].all()
    assert not mask[:, :5].any()


# --- bad photographs ------------------------------------------------------------------------


def test_sensors_without_a_photograph_can_be_left_out(scene):
    """They are views that are not used; with no photograph at all there is nothing to load."""
    images = scene.parent / "images"
    capture = load_capture(scene)
    for name in ("view_0001.exr", "view_0002.exr"):
        (images / name).unlink()
    partly = load_capture(scene, missing="leave-out")
    assert partly.used == (True, False, False)
    assert partly.names == ("view_0000.exr", "view_0001.exr", "view_0002.exr")
    np.testing.assert_array_equal(partly.images[0], capture.images[0])
    assert partly.masks[1] is None and partly.unusable == (0, 0, 0)
    for image in partly.images[1:]:
        assert image.shape == (24, 24, 3) and image.dtype == np.float32 and np.isnan(image).all()
        assert image.strides == (0, 0, 0)  # one number, whatever the film
    (images / "view_0000.exr").unlink()
    with pytest.raises(CaptureError, match="3 of 3 photographs are missing"):
        load_capture(scene, missing="leave-out")
    with pytest.raises(OptionError, match="one of refuse, leave-out, got 'ignore'"):
        svu.load_capture(scene, missing="ignore")


def renamed(folder, name):
    """Give the photographs of a folder other names, by their number."""
    for index, path in enumerate(sorted(folder.glob("view_*"))):
        path.rename(folder / f"{name(index)}.exr")


def test_photographs_are_matched_by_the_ids_of_their_sensors(scene):
    """In whatever order their names are: here the reverse one."""
    folder = scene.parent / "images"
    scene.write_text(scene.read_text().replace("cam0", "night").replace("cam1", "evening"))
    for index in range(3):
        image = np.full((24, 24, 3), 0.1 * (index + 1))
        write_exr(folder / f"view_{index:04d}.exr", {"RGB": image})
    renamed(folder, ["night", "evening", "cam2"].__getitem__)
    capture = load_capture(scene)
    assert capture.names == capture.files == ("night.exr", "evening.exr", "cam2.exr")
    assert [round(float(image.mean()), 3) for image in capture.images] == [0.1, 0.2, 0.3]
    (folder / "cam2.exr").rename(folder / "cam3.exr")
    message = r"1 of 3 photographs is missing, first cam2.exr; add them, or continue without them"
    with pytest.raises(CaptureError, match=message):
        load_capture(scene)
    with pytest.raises(CaptureError, match="cam3.exr: no sensor has this name; the folder has 3"):
        load_capture(scene, missing="leave-out")
    (folder / "cam3.exr").unlink()
    assert load_capture(scene, missing="leave-out").used == (True, True, False)


@pytest.mark.parametrize("mask", ["IMG_{}_mask", "mask_IMG_{}"])
def test_photographs_of_any_name_are_in_natural_order(tmp_path, mask):
    """2 before 10; their masks are none of them, nor what macOS hides beside them."""
    path = write_scene(tmp_path, sensors=sensor_xml(11))
    folder = tmp_path / "images"
    folder.mkdir()
    for index in range(11):
        image = np.full((24, 24, 3), 0.01 * (index + 1))
        write_exr(folder / f"IMG_{index}.exr", {"RGB": image})
        (folder / f"._IMG_{index}.exr").write_bytes(b"")
    inside = np.zeros((24, 24), np.uint8)
    inside[:7] = 255
    Image.fromarray(inside).save(folder / f"{mask.format(3)}.png")
    with pytest.warns(SvuWarning) as said:
        capture = load_capture(path, folder)
    assert [str(warning.message) for warning in said] == [
        f"{folder}: 11 photographs are assigned to sensors in the order of their names: IMG_0.exr "
        "is sensor 0 ('cam0'), ..., IMG_10.exr is sensor 10 ('cam10')."
    ]
    assert capture.names == tuple(f"IMG_{index}.exr" for index in range(11))
    assert [round(100 * float(image.mean())) for image in capture.images] == list(range(1, 12))
    assert [mask is None for mask in capture.masks] == [index != 3 for index in range(11)]
    assert capture.masks[3][:7].all() and not capture.masks[3][7:].any()


def test_textures_beside_a_scene_are_no_photographs(tmp_path):
    path = write_scene(tmp_path, sensors=sensor_xml(1))
    write_exr(tmp_path / "base_color.exr", {"RGB": np.ones((24, 24, 3))})
    message = f"{tmp_path}: 1 of 1 photographs is missing, first cam0.exr; no image there"
    with pytest.raises(CaptureError, match=message):
        load_capture(path)


@pytest.mark.parametrize("count", [1, 3])
def test_textures_in_images_are_no_photographs(tmp_path, capsys, count):
    """The usual folder of a scene's textures; as many as sensors are still none of them."""
    path, folder = write_scene(tmp_path), tmp_path / "images"
    folder.mkdir()
    for name in ("base_color", "metallic", "roughness")[:count]:
        write_exr(folder / f"{name}.exr", {"RGB": np.ones((24, 24, 3))})
    assert fails(capsys, "entropy", path, "-o", tmp_path / "out") == (
        f"svu: {path}: no photographs next to it; give their folder with --images, or --render to "
        "render the scene itself (3 sensors)."
    )
    for index in range(3):  # beside the scene, by the ids of their sensors
        write_exr(tmp_path / f"cam{index}.exr", {"RGB": np.full((24, 24, 3), 0.5)})
    assert load_capture(path).names == ("cam0.exr", "cam1.exr", "cam2.exr")


def test_an_error_comes_back_from_another_process(tmp_path):
    with pytest.raises(NoPhotographsError) as caught:
        load_capture(write_scene(tmp_path))
    again = pickle.loads(pickle.dumps(caught.value))
    assert (str(again), again.sensors) == (str(caught.value), 3)


@pytest.mark.filterwarnings("default::svu_mi.errors.SvuWarning")
def test_imported_photographs_keep_the_names_that_they_had(scene):
    """In messages; their files are called by their number."""
    folder = scene.parent / "images"
    paths = ["left/IMG_7.JPG", "left/IMG_8.JPG", "right/IMG_9.JPG"]
    record = {"format": "svu-capture", "import": {"photographs": paths}}
    write_exr(folder / "view_0001.exr", {"RGB": np.zeros((24, 24, 3))})

    def load():
        (folder / "capture.json").write_text(json.dumps(record))
        return load_capture(scene)

    capture = load()
    assert capture.names == ("IMG_7.JPG", "IMG_8.JPG", "IMG_9.JPG")
    assert capture.files == ("view_0000.exr", "view_0001.exr", "view_0002.exr")
    assert capture.warnings == (
        f"{folder / 'view_0001.exr'} (IMG_8.JPG): entirely black, not used; check the "
        "exposure and objects before the camera, or remove the photograph and its sensor.",
    )
    paths[2] = "right/IMG_7.JPG"  # a camera of its own, that counts like the first
    assert load().names == tuple(paths)
    for odd in ([*paths, "more.jpg"], paths[:2], [1, 2, 3], "three"):
        record["import"]["photographs"] = odd
        assert load().names == capture.files


def copied(name):
    return lambda folder: shutil.copy(folder / "view_0000.exr", folder / name)


def written(data):
    return lambda folder: (folder / "view_0002.exr").write_bytes(data)


PHOTOGRAPHS = {
    "missing": (
        lambda folder: (folder / "view_0001.exr").unlink(),
        "1 of 3 photographs is missing, first view_0001.exr",
    ),
    "extra": (copied("view_0003.exr"), "view_0003.exr.*4 photographs for 3 sensors"),
    "twice": (copied("view_0000.hdr"), "are the same view"),
    "empty": (written(b""), "view_0002.exr: an empty file"),
    "black": (
        lambda folder: write_images(folder, 3, value=0.0), "all 3 photographs are entirely black"
    ),
    "another": (written(b"not an image"), "view_0002.exr: not an EXR file"),
    "cut": (written(b"\x76\x2f\x31\x01\x02\0\0\0"), "view_0002.exr: a damaged EXR file"),
    "of another size": (
        lambda folder: write_exr(folder / "view_0001.exr", {"RGB": np.ones((12, 24, 3))}),
        "view_0001.exr.*24 x 12 pixels.*film has 24 x 24",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "message"), PHOTOGRAPHS.values(), ids=PHOTOGRAPHS)
def test_error_names_the_unusable_photograph(scene, spoil, message):
    spoil(scene.parent / "images")
    with pytest.raises(CaptureError, match=message):
        load_capture(scene)


@pytest.mark.parametrize("worst", [0, 7])
def test_error_names_first_bad_image_for_any_thread_order(tmp_path, worst):
    path = write_scene(tmp_path, sensors=sensor_xml(12))
    folder = write_images(tmp_path / "images", 12)
    for index in range(worst, 12):
        (folder / f"view_{index:04d}.exr").write_bytes(b"" if index % 2 else b"no image")
    with pytest.raises(CaptureError, match=f"view_{worst:04d}.exr"):
        load_capture(path)


def test_photograph_replaced_while_read_is_refused(scene):
    path = scene.parent / "images" / "view_0000.exr"
    picture = open_image(path)
    write_exr(path, {"RGB": np.ones((24, 24, 3))}, {"svu:run": "12ab"})
    with pytest.raises(CaptureError, match="view_0000.exr: changed while it was being read"):
        picture.planes()


def test_invalid_pixels_are_masked_and_counted(scene):
    image = np.full((24, 24, 3), 0.5, np.float32)
    image[0, 0, 0], image[3, 4, 1], image[5, 5, 2], image[6, 6] = np.nan, np.inf, -1, -np.inf
    path = scene.parent / "images" / "view_0001.exr"
    shutil.copy(path, path.with_suffix(".bak"))
    _write_raw_exr(path, image)
    with pytest.warns(SvuWarning, match="view_0001.exr: 4 pixels are NaN, infinite or negative"):
        capture = load_capture(scene)
    assert capture.unusable == (0, 4, 0)
    assert np.isnan(capture.images[1][0, 0]).all()
    assert np.isfinite(capture.images[1]).all(axis=-1).sum() == 24 * 24 - 4


def _write_raw_exr(path, image):
    """Write values that our own writer refuses."""
    import OpenEXR

    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": image}) as file:
        file.write(str(path))


def test_black_photograph_is_unused_with_a_warning(scene):
    write_exr(scene.parent / "images" / "view_0001.exr", {"RGB": np.zeros((24, 24, 3))})
    with pytest.warns(SvuWarning, match="view_0001.exr: entirely black, not used"):
        capture = load_capture(scene)
    assert capture.used == (True, False, True)


@pytest.mark.filterwarnings("default::svu_mi.errors.SvuWarning")
def test_thirty_8_bit_photographs_are_one_warning(tmp_path):
    path = write_scene(tmp_path, sensors=sensor_xml(30))
    folder = tmp_path / "images"
    folder.mkdir()
    pixels = np.full((24, 24, 3), 188, np.uint8)
    pixels[:2] = 255
    for index in range(30):
        Image.fromarray(pixels).save(folder / f"view_{index:04d}.png")
    assert load_capture(path).warnings == (
        f"{folder}: all 30 photographs: 8-bit, not HDR; decoded as sRGB, 1440 saturated "
        "pixels, with the background, are lower bounds of radiance. Clipped highlights hide gloss: "
        "use HDR.",
    )
    alpha = np.full((24, 24, 1), 255, np.uint8)
    alpha[0] = 0  # one of the two saturated rows
    for image in folder.iterdir():
        Image.fromarray(np.concatenate([pixels, alpha], axis=2)).save(image)
    assert "sRGB, 720 saturated pixels are lower" in load_capture(path).warnings[0]
    for index in (3, 4, 9, 20, 21):
        write_exr(folder / f"view_{index:04d}.exr", {"RGB": np.zeros((24, 24, 3))})
        (folder / f"view_{index:04d}.png").unlink()
    sentences = load_capture(path).warnings
    assert sentences == (
        f"{folder}: 25 of 30 photographs (view_0000.png, view_0001.png, view_0002.png and 22 "
        "more): 8-bit, not HDR; decoded as sRGB, 600 saturated pixels are "
        "lower bounds of radiance. Clipped highlights hide gloss: use HDR.",
        f"{folder}: 5 of 30 photographs (view_0003.exr, view_0004.exr, view_0009.exr and 2 more): "
        "entirely black, not used; check the exposure and objects before the camera, or remove "
        "the photograph and its sensor.",
    )


# --- bad scenes -----------------------------------------------------------------------------


def test_missing_files_and_folders_are_refused(scene):
    with pytest.raises(CaptureError, match="nothing.xml: no such file"):
        load_capture(scene.parent / "nothing.xml")
    with pytest.raises(CaptureError, match="nowhere: no such folder"):
        load_capture(scene, scene.parent / "nowhere")


BROKEN = {
    "unknown plugin": ({"extra": '<bsdf type="plyx"/>'}, r'scene.xml: .*"plyx" not found'),
    "misnamed texture": (
        {"extra": '<bsdf type="principled"><texture type="checkerboard" name="rough"/></bsdf>'},
        r'unreferenced property in .* object "rough"\.$',
    ),
    "no sensor": ({"sensors": ""}, "the scene has no sensor; add one"),
    "projector": ({"emitter": "projector"}, r"'light' \(Projector\) is not supported; use envmap"),
    "mirrored camera": (
        {"sensors": sensor_xml(1, matrix='<scale x="-1"/><translate z="4"/>')}, "mirrored to_world"
    ),
    "scaled camera": (
        {"sensors": sensor_xml(1, matrix='<scale value="2"/><translate z="4"/>')}, "Scale factors"
    ),
    "orthographic camera": (
        {"sensors": sensor_xml(1).replace('"perspective"', '"orthographic"').replace(
            '<float name="fov" value="35"/>', "")}, "'cam0'.*Orthographic.*only 'perspective'",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), BROKEN.values(), ids=BROKEN)
def test_unsupported_scene_is_refused(tmp_path, changes, message):
    with pytest.raises(SceneError, match=message):
        load_capture(write_scene(tmp_path, **changes))


def test_no_emitter(tmp_path):
    """What can do without a light asks for that."""
    path = photographed(tmp_path)
    assert load_capture(path, light="optional").environment.id() == "light"
    path.write_text(path.read_text().replace('<emitter type="constant" id="light"/>', ""))
    with pytest.raises(SceneError, match="no emitter"):
        load_capture(path)
    capture = load_capture(path, light="optional")
    assert capture.environment is None
    with pytest.raises(SceneError, match=r"the capture has no light; estimate it with svu"):
        estimate(capture, texels(capture.mesh, 16))
    with pytest.raises(OptionError, match="light must be one of required, optional, got 'no'"):
        svu.load_capture(path, light="no")
    record = {"format": "svu-capture", "import": {"format": "nerf"}}
    (tmp_path / "images" / "capture.json").write_text(json.dumps(record))
    with pytest.raises(SceneError) as refused:
        load_capture(path)
    start = f"{tmp_path / 'images'}: was imported without a light; "
    assert str(refused.value).startswith(f'{start}load it with light="optional" and add svu.wi')
    assert refused.value.shell.startswith(f"{start}estimate it with svu light, or")


# --- what is ignored is said ----------------------------------------------------------------


PRINCIPLED = {"type": "principled", "id": "paint"}
IGNORED = {
    "clearcoat and anisotropy": (
        {**PRINCIPLED, "clearcoat": 1.0, "anisotropic": 0.8}, "clearcoat 1 and anisotropic 0.8"
    ),
    "a clearcoat texture": (
        {**PRINCIPLED, "clearcoat": {"type": "checkerboard"}}, "a clearcoat texture"
    ),
    "sheen and transmission": (
        {**PRINCIPLED, "sheen": 1.0, "spec_trans": 0.5}, "sheen 1 and spec_trans 0.5"
    ),
    "specular": ({**PRINCIPLED, "specular": 0.9}, "specular 0.9"),
    "a refractive index": ({**PRINCIPLED, "eta": 1.8}, "eta 1.8"),
    "opacity": ({"type": "mask", "opacity": 0.4, "inner": PRINCIPLED}, "an opacity"),
}  # fmt: skip


def shape_of(bsdf, name="ball", **changes):
    return mi.load_dict({"type": "sphere", "id": name, "bsdf": bsdf, **changes})


@pytest.mark.parametrize(("bsdf", "words"), IGNORED.values(), ids=IGNORED)
def test_unsupported_material_features_cause_a_warning(bsdf, words):
    shape = shape_of(bsdf)
    assert unsupported(make_scene([shape]), shape) == [
        f"Shape 'ball' has {words}, which svu does not account for: if the photographs show that, "
        "roughness and base colour will be off."
    ]


@pytest.mark.parametrize(("kind", "name"), [("normalmap", "normalmap"), ("bumpmap", "heights")])
def test_normal_map_that_fits_no_texel_causes_a_warning(kind, name):
    heights = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.zeros((2, 2, 1), np.float32))}
    shape = shape_of({"type": "twosided", "a": {"type": kind, name: heights, "b": PRINCIPLED}})
    assert unsupported(make_scene([shape]), shape) == []
    (sentence,) = unsupported(make_scene([shape]), shape, own_uvs=False)
    assert sentence.startswith(f"Shape 'ball' has a {kind[:-3]} map, which svu does not account")


@pytest.mark.parametrize("raw", [False, True])
def test_normal_map_that_is_read_as_colours_causes_a_warning(raw):
    flat = mi.Bitmap(np.full((2, 2, 3), [128, 128, 255], np.uint8))
    shape = shape_of({
        "type": "normalmap", "normalmap": {"type": "bitmap", "bitmap": flat, "raw": raw},
        "inner": PRINCIPLED,
    })  # fmt: skip
    notes = unsupported(make_scene([shape]), shape)
    assert [
        note.startswith("The normal map of shape 'ball' is decoded as sRGB") for note in notes
    ] == [True] * (not raw)


@pytest.mark.parametrize("top", [1.0, 0.9])
def test_mask_of_a_bitmap_without_holes_causes_no_warning(top):
    alpha = mi.Bitmap(np.array([[[1.0], [1.0]], [[1.0], [top]]], np.float32))
    opacity = {"type": "bitmap", "raw": True, "bitmap": alpha}
    shape = shape_of({"type": "mask", "opacity": opacity, "inner": PRINCIPLED})
    assert len(unsupported(make_scene([shape]), shape)) == (top < 1)


@pytest.mark.parametrize("bsdf", [
    PRINCIPLED, {"type": "twosided", "inner": PRINCIPLED}, {"type": "diffuse"},
    {"type": "principled", "eta": 1.5, "base_color": {"type": "checkerboard"}, "metallic": 1.0},
])  # fmt: skip
def test_supported_materials_cause_no_warning(bsdf):
    shape = shape_of(bsdf)
    assert unsupported(make_scene([shape]), shape) == []


def test_grey_table_under_the_object_causes_a_warning(tmp_path):
    table = (
        '<shape type="rectangle" id="table"><transform name="to_world"><rotate x="1" angle="-90"/>'
        '<translate y="-1.1"/></transform><bsdf type="diffuse"><rgb name="reflectance" '
        'value="0.5"/></bsdf></shape>'
    )
    sentence = (
        "Light reflected by 'table' falls on 'ball': the presets default and fixed account for it, "
        "but not other presets, svu light, and the comparisons of light by svu check."
    )
    path = write_scene(tmp_path, extra=table)
    path.write_text(path.read_text().replace('type="direct"', 'type="path"'))
    with pytest.warns(SvuWarning) as said:
        capture = render_capture(path, spp=1, shape="ball")
    assert [str(warning.message) for warning in said] == [sentence]
    assert capture.warnings == (sentence,)
    del capture  # beside which the next would take kernels of its own
    path.write_text(path.read_text().replace('value="0.5"', 'value="0"'))
    assert render_capture(path, spp=1).warnings == ()


GREY = {"type": "diffuse"}
DARK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.05}}
SPOT = np.zeros((4, 4, 3), np.float32)
SPOT[1, 2] = 0.5


def painted(data):
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True}


BLACK = {
    "dark": lambda: DARK,
    "two-sided": lambda: {"type": "twosided", "inner": DARK},
    "bitmap": lambda: {"type": "diffuse", "reflectance": painted(0 * SPOT)},
    "invisible": lambda: {"type": "mask", "opacity": 0.0, "inner": GREY},
    "half": lambda: {"type": "mask", "opacity": 0.5, "inner": DARK},
    "plastic": lambda: {"type": "roughplastic", "diffuse_reflectance": 0.02},
    "blend": lambda: {"type": "blendbsdf", "weight": 0.5, "a": DARK, "b": DARK},
}
BRIGHT = {
    "grey": lambda: {"type": "diffuse", "reflectance": 0.06},
    "spot": lambda: {"type": "diffuse", "reflectance": painted(SPOT)},
    "seen": lambda: {"type": "mask", "opacity": 0.5, "inner": GREY},
    "plastic": lambda: {"type": "plastic", "diffuse_reflectance": 0.3},
    "gloss": lambda: {"type": "plastic", "diffuse_reflectance": 0.0, "int_ior": 2.4},
    "blend": lambda: {"type": "blendbsdf", "weight": 0.5, "a": DARK, "b": GREY},
    "metal": lambda: {"type": "conductor"},
    "glass": lambda: {"type": "dielectric"},
}


@pytest.mark.parametrize(
    ("bsdf", "said"), [*((b, False) for b in BLACK.values()), *((b, True) for b in BRIGHT.values())]
)
def test_bright_shapes_cause_a_warning(bsdf, said):
    target = shape_of(PRINCIPLED)
    notes = unsupported(make_scene([target, shape_of(bsdf(), "wall", center=[3, 0, 0])]), target)
    assert [each.startswith("Light reflected by 'wall' falls") for each in notes] == [True] * said


def test_shapes_reflect_nothing_in_photographs_of_direct_light():
    """A renderer of direct light leaves the reflected light out."""
    target, wall = shape_of(PRINCIPLED), shape_of(GREY, "wall", center=[3, 0, 0])
    for integrator, said in (
        ({"type": "direct"}, 0), ({"type": "path", "max_depth": 2}, 0),
        ({"type": "prb", "max_depth": 2}, 0), ({"type": "path", "max_depth": 3}, 1),
        ({"type": "path"}, 1),
    ):  # fmt: skip
        scene = make_scene([mi.load_dict(integrator), target, wall])
        assert len(unsupported(scene, target)) == said


def test_bright_shapes_share_one_warning():
    target = shape_of(PRINCIPLED)
    others = [shape_of({"type": "diffuse"}, f"wall{k}", center=[3 + k, 0, 0]) for k in range(7)]
    (sentence,) = unsupported(make_scene([target, *others[:2]]), target)
    assert sentence.startswith("Light reflected by 'wall0' and 'wall1' falls on 'ball': ")
    far = shape_of({"type": "diffuse"}, "moon", center=[1000, 0, 0], radius=100.0)
    (sentence,) = unsupported(make_scene([target, others[0], far]), target)
    assert sentence.startswith("Light reflected by 'wall0' falls on 'ball': ")
    (sentence,) = unsupported(make_scene([target, *others]), target)
    assert "'wall0', 'wall1', 'wall2', 'wall3', 'wall4' and others falls on" in sentence


# --- scenes with several shapes -------------------------------------------------------------


SECOND = (
    '<shape type="ply" id="other"><string name="filename" value="ball.ply"/>'
    '<bsdf type="principled"/></shape>'
)


def test_two_candidate_shapes_need_a_choice(tmp_path):
    path = photographed(tmp_path, extra=SECOND)
    with pytest.raises(
        SceneError, match=r"several shapes.*--shape ball \(PLYMesh\), --shape other"
    ):
        load_capture(path)
    assert load_capture(path, shape="other").shape.id() == "other"
    with pytest.raises(SceneError, match=r"no shape 'third'.*ball \(PLYMesh\), --shape other"):
        load_capture(path, shape="third")


def test_a_mesh_without_uvs_is_unwrapped_with_a_warning(tmp_path):
    with pytest.warns(SvuWarning, match="'ball' has no UVs.*unwrapped.ply"):
        capture = load_capture(photographed(tmp_path, uvs=None))
    assert capture.mesh is not capture.shape
    assert (tmp_path / "images" / "unwrapped.ply").exists()


def test_a_mirrored_camera_in_a_capture_folder_is_refused(scene):
    folder = scene.parent / "images"
    record = describe(sphere_sensors(mi.load_dict({"type": "sphere"}), 1, (24, 24))[0])
    record["to_world"] = (np.array(record["to_world"]) @ np.diag([-1, 1, 1, 1])).tolist()
    text = json.dumps({"format": "svu-capture", "sensors": [record] * 3})
    (folder / "capture.json").write_text(text)
    with pytest.raises(SceneError, match="sensor 0.*mirrored"):
        load_capture(scene)


def test_a_mirrored_mesh_keeps_its_outside_if_it_has_normals(tmp_path):
    mirror = '<transform name="to_world"><scale x="-1"/></transform>'
    load_capture(photographed(tmp_path, transform=mirror))
    path = write_scene(tmp_path, transform=mirror, normals=None)
    with pytest.raises(SceneError, match="point inwards.*flip_normals"):
        load_capture(path)
    # The fix that the sentence names works.
    flipped = mirror + '<boolean name="flip_normals" value="true"/>'
    capture = load_capture(write_scene(tmp_path, transform=flipped, normals=None))
    outward = texels(capture.mesh, 32)
    assert (outward.normal.numpy() * outward.position.numpy()).sum(axis=0).min() > 0.9


def test_an_open_bowl_seen_from_inside_is_accepted(tmp_path):
    """Its normals point towards its centre, and that is right."""
    flat = ball()
    lower = flat.positions[flat.faces].mean(axis=1)[:, 1] < -0.1
    path = photographed(tmp_path, faces=flat.faces[lower][:, ::-1], normals=-flat.normals)
    assert load_capture(path).shape.id() == "ball"


@pytest.mark.parametrize("name", ["scalar_rgb", "llvm_ad_spectral", "llvm_ad_mono"])
def test_variants_that_cannot_run_are_refused(scene, variant, name):
    try:
        mi.set_variant(name)
        with pytest.raises(SvuEnvironmentError, match=f"'{name}' is not supported.*llvm_ad_rgb"):
            load_capture(scene)
    finally:
        mi.set_variant(variant)


def test_spp_and_views_must_be_positive(tmp_path):
    path = write_scene(tmp_path)
    for words, sentence in (({"spp": 0}, "spp must be at least 1"),
                            ({"seed": -1}, "seed must not be negative"),
                            ({"views": 0}, "Cannot place 0 sensors")):  # fmt: skip
        with pytest.raises(OptionError, match=sentence):
            render_capture(path, **words)


def test_photographs_of_others_are_not_overwritten(scene):
    folder = scene.parent / "images"
    with pytest.raises(OutputError, match="view_0000.exr was not written by svu render"):
        render_capture(scene, spp=1, folder=folder)
    assert read_exr(folder / "view_0000.exr")["R"].mean() == 0.5


def test_tiny_meshes_are_unwrapped_like_large_ones():
    """xatlas alone takes the triangles of a ball of 3 mm, in metres, for degenerate ones."""
    given = ball(24, 12)
    small = make_mesh("ball", replace(given, positions=given.positions * 1e-3, uvs=None))
    assert np.isfinite(arrays(unwrap(small)).uvs).all()


def test_views_that_are_not_read_are_not_used(shot):
    some, whole = load_capture(shot, views=[2, 5]), load_capture(shot)
    assert some.used == tuple(view in (2, 5) for view in range(8))
    assert some.names == whole.names and some.count == 8
    np.testing.assert_array_equal(some.images[5], whole.images[5])
    assert np.isnan(some.images[0]).all() and some.images[0].strides == (0, 0, 0)
    assert not any(load_capture(shot, views=()).used)


def test_views_are_chosen_by_flags(shot):
    """Flags are not taken for the indices 0 and 1, which they equal in Python."""
    flags = np.arange(8) % 3 == 2
    capture = load_capture(shot, views=flags)
    assert capture.used == tuple(flags)
    assert svu.Candidates.at(capture, flags.tolist()).names == capture.names[2::3]
    for views, problem in (([True] * 7, "7 flags for 8 views"), ([8], "no view 8"), ([-1], "no v")):
        with pytest.raises(OptionError, match=f"load_capture\\(\\): {problem}"):
            load_capture(shot, views=views)
        with pytest.raises(OptionError, match=f"Candidates.at\\(\\): {problem}"):
            svu.Candidates.at(capture, views)


def test_one_photograph_as_two_files_is_refused(scene):
    folder = scene.parent / "images"
    renamed(folder, "DSC{}".format)
    shutil.copy(folder / "DSC1.exr", folder / "DSC1.hdr")
    with pytest.raises(CaptureError, match=r"DSC1.exr and DSC1.hdr are the same view; keep one"):
        load_capture(scene, folder)


@pytest.mark.parametrize(
    ("default", "known"),
    [('<default name="light" value="1"/>', r"\$light"), ("", "no parameters")],
)
def test_unknown_parameters_are_answered_with_the_known_ones(tmp_path, default, known):
    path = tmp_path / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{default}</scene>')
    with pytest.raises(SceneError, match=rf"unused .*foo.* The file has {known}\."):
        load_capture(path, defines={"foo": "bar"})


WITHOUT_MODEL = {
    "glass": ('<bsdf type="dielectric"/>', r"'ball' transmits light \(SmoothDielectric\)"),
    "window": ('<bsdf type="thindielectric"/>', r"'ball' transmits light \(ThinDielectric\)"),
    "lamp": (
        '<bsdf type="diffuse"/><emitter type="area"/>',
        "'ball' emits light, .* remove its emitter",
    ),
    "nothing": ('<bsdf type="null"/>', r"'ball' is invisible \(Null\)"),
}


@pytest.mark.parametrize(("content", "message"), WITHOUT_MODEL.values(), ids=WITHOUT_MODEL)
def test_object_that_is_no_surface_of_the_model_is_refused(tmp_path, content, message):
    path = write_scene(tmp_path)
    path.write_text(path.read_text().replace('<bsdf type="principled" id="paint"/>', content))
    with pytest.raises(SceneError, match=f"scene.xml: shape {message}"):
        render_capture(path, spp=1, shape="ball")


def test_mask_that_hides_nothing_is_ignored(tmp_path):
    """Exporters write it around each material; its object is the same as without it."""
    inner = (
        '<bsdf type="twosided" id="two"><bsdf type="principled"><rgb name="base_color" '
        'value="0.2, 0.4, 0.6"/><float name="roughness" value="0.25"/></bsdf></bsdf>'
    )
    path, seen = write_scene(tmp_path), []
    text = path.read_text()
    for opacity in ('<float name="opacity" value="1"/>', '<rgb name="opacity" value="1, 1, 1"/>'):
        mask = f'<bsdf type="mask" id="paint">{opacity}{inner}</bsdf>'
        path.write_text(text.replace('<bsdf type="principled" id="paint"/>', mask))
        capture = render_capture(path, spp=2, shape="paint")
        assert capture.warnings == ()
        truth = ground_truth(capture, texels(capture.mesh, 8))
        seen.append(capture.images[0])
        np.testing.assert_allclose(truth["base_color"], [[0.2, 0.4, 0.6]] * len(truth["roughness"]))
        np.testing.assert_allclose(truth["roughness"], 0.25)
    path.write_text(text.replace('<bsdf type="principled" id="paint"/>', inner))
    np.testing.assert_array_equal(render_capture(path, spp=2).images[0], seen[0])
    path.write_text(path.read_text().replace(inner, f'<bsdf type="mask">{inner}</bsdf>'))
    with pytest.warns(SvuWarning, match="'ball' has an opacity, which svu does not account for"):
        render_capture(path, spp=1)  # half of the light passes by default


def test_medium_causes_a_warning():
    glass = {"type": "dielectric"}
    milk = shape_of(glass, "milk", center=[3, 0, 0], interior={"type": "homogeneous"})
    target = shape_of(PRINCIPLED)
    first, *_ = unsupported(make_scene([target, milk]), target)
    assert first.startswith("Light is scattered in the medium of 'milk', which svu does not acc")


def test_reason_of_a_renderer_is_printed(tmp_path):
    path = write_scene(tmp_path)
    warm = (
        '<emitter type="constant"><spectrum name="radiance" type="blackbody">'
        '<float name="temperature" value="4000"/></spectrum></emitter>'
    )
    path.write_text(path.read_text().replace('<emitter type="constant" id="light"/>', warm))
    with pytest.raises(SceneError, match="cam0.*BlackBodySpectrum. Not implemented for non-spect"):
        render_capture(path, spp=1)
