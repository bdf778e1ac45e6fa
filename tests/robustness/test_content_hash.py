"""The key of a capture: the same wherever the files lie, another after any change of them."""

from __future__ import annotations

import shutil
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball, memory_capture, peak_memory, python, sensor_xml, write_scene

import svu_mi as svu
from svu_mi.capture.content_hash import Key, _are_computed, capture_key, capture_parts
from svu_mi.capture.loading import load_capture
from svu_mi.capture.mesh import MeshArrays, make_mesh
from svu_mi.capture.quantization import Rounding, Saturation
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.hashes import digest_of, digest_of_file
from svu_mi.errors import OptionError, SvuWarning
from svu_mi.evaluation import reference_cache
from svu_mi.evaluation.reference_options import ReferenceOptions
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.recovery.recovery_options import SH_PRESETS, DescentOptions
from svu_mi.recovery.recovery_run import recovery_digests

# The scene has another shape, which reflects light; a change of the material is unsupported.
IGNORED = "ignore:Light reflected by|.* which svu does not account for:svu_mi.errors.SvuWarning"
pytestmark = pytest.mark.filterwarnings(IGNORED)

SCRIPT = """
import sys
import svu_mi, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from svu_mi.capture.loading import load_capture
from svu_mi.capture.mesh import MeshArrays, make_mesh
from svu_mi.capture.content_hash import capture_key
print(capture_key(load_capture(sys.argv[1], unwrap=True)))
"""
OTHERS = """
<shape type="ply"><string name="filename" value="other.ply"/>
  <transform name="to_world"><translate x="9"/></transform>
  <bsdf type="roughconductor"><string name="distribution" value="beckmann"/></bsdf></shape>
<shape type="rectangle"><transform name="to_world"><translate z="-5"/></transform>
  <bsdf type="twosided"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
    <string name="filename" value="texture.exr"/></texture></bsdf></bsdf></shape>
"""


def write(folder):
    """Write a scene with nodes without ids, a texture, and a mesh whose normals are computed."""
    folder.mkdir(exist_ok=True)
    path = write_scene(folder, sensors=sensor_xml(2, 16, 8), extra=OTHERS)
    other = replace(ball(180, 90), normals=None)  # so many that the order of sums differs
    make_mesh("other", other).write_ply(str(folder / "other.ply"))
    rng = np.random.default_rng(911)
    for name in ("texture", "sky", "images/view_0000", "images/view_0001"):
        (folder / "images").mkdir(exist_ok=True)
        write_exr(folder / f"{name}.exr", {"RGB": rng.random((8, 16, 3), np.float32)})
    text = path.read_text().replace('<integrator type="direct"/>', (
        '<integrator type="path"><integer name="max_depth" value="5"/></integrator>'
    ))  # fmt: skip
    path.write_text(text.replace('<emitter type="constant" id="light"/>', (
        '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    )))  # fmt: skip
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def capture(scene):
    return load_capture(scene)


def test_key_of_files_is_equal_in_every_process_and_folder(scene, tmp_path):
    """Although Mitsuba sums up missing normals in an order of its own each time."""
    copy = shutil.copytree(scene.parent, tmp_path / "copied to another place")
    with pytest.warns(SvuWarning, match="unwrapped again"):
        key = capture_key(load_capture(scene, unwrap=True))
    done = python("-W", "ignore", "-c", SCRIPT, copy / scene.name)
    assert done.stdout.strip() == key and len(key) == 32, done.stderr


def test_names_and_loading_again_do_not_matter(capture, scene):
    assert capture_parts(load_capture(scene)) == capture_parts(capture)
    assert capture_key(replace(capture, names=("a", "b"), source=None)) == capture_key(capture)


CHANGES = {
    "integrator depth": ('value="5"', 'value="4"', "integrator"),
    "integrator": ('type="path"', 'type="volpath"', "integrator"),
    "hidden light": (
        "</integrator>", '<boolean name="hide_emitters" value="true"/></integrator>', "integrator"
    ),
    "field of view": ('name="fov" value="35"', 'name="fov" value="36"', "sensors"),
    "principal point": (
        '<float name="fov"', '<float name="principal_point_offset_x" value="0.01"/>'
        '<float name="fov"', "sensors",
    ),
    "pose": ("4.000000", "4.000010", "sensors"),
    "distribution": ("beckmann", "ggx", "shapes"),
    "roughness": ('value="beckmann"/>', 'value="beckmann"/><float name="alpha" value="0.2"/>',
                  "shapes"),
    "other shape": ('z="-5"', 'z="-5.001"', "shapes"),
    "other kind": ('"rectangle"', '"disk"', "shapes"),
    "sides": ('"other.ply"/>', '"other.ply"/><boolean name="flip_normals" value="true"/>',
              "shapes"),
    "material": ('<bsdf type="principled" id="paint"/>', '<bsdf type="principled" id="paint">'
                 '<float name="specular" value="0.4"/></bsdf>', "shapes"),
    "scale of the light": ('value="sky.exr"/>', 'value="sky.exr"/><float name="scale" value="2"/>',
                           "light"),
    "turned light": ('value="sky.exr"/>', 'value="sky.exr"/><transform name="to_world">'
                     '<rotate y="1" angle="1"/></transform>', "light"),
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGES)
def test_scene_changes_affect_the_digest_of_their_part(capture, scene, change):
    old, new, part = CHANGES[change]
    text = scene.read_text()
    assert old in text
    path = scene.with_name("changed.xml")
    path.write_text(text.replace(old, new))
    assert differing(capture, load_capture(path)) == {part}


def differing(first, second):
    a, b = capture_parts(first), capture_parts(second)
    assert (capture_key(first) == capture_key(second)) == (a == b)
    return {name for name in a if a[name] != b[name]}


def test_photograph_changes_affect_the_digest_of_their_part(capture):
    images = [image.copy() for image in capture.images]
    images[1][3, 5, 2] *= 1 + 1e-6
    assert differing(capture, replace(capture, images=tuple(images))) == {"photographs"}
    masks = (np.ones((8, 16), bool), None)
    assert differing(capture, replace(capture, masks=masks)) == {"masks"}
    assert differing(capture, replace(capture, exposures=(1.0, 2.0))) == {"exposures"}
    fine, coarse = (replace(capture, rounding=(None, Rounding.of(bits))) for bits in (16, 8))
    low, high = (Saturation(np.full((8, 16), 7, np.uint8), np.full(3, x)) for x in (0.9, 1.0))
    low, high = (replace(capture, clipped=(None, saturated)) for saturated in (low, high))
    for pair in ((capture, fine), (fine, coarse), (capture, low), (low, high)):
        assert differing(*pair) == {"photographs"}
    unused = replace(capture, used=(True, False))
    assert "photographs" in differing(capture, unused)
    assert not differing(unused, replace(unused, images=(capture.images[0], images[1])))


def test_another_mesh_or_texture_changes_the_digest(capture, tmp_path):
    scene = write(tmp_path / "other")
    write_exr(scene.parent / "texture.exr", {"RGB": np.full((8, 16, 3), 0.5, np.float32)})
    assert differing(capture, load_capture(scene)) == {"shapes"}


def test_a_live_scene_that_was_edited_has_another_key(scene):
    capture = load_capture(scene)
    before = capture_parts(capture)
    params = mi.traverse(capture.scene)
    (name,) = [key for key in params.keys() if key.endswith("alpha.value")]  # noqa: SIM118
    params[name] = 0.3
    params.update()
    after = capture_parts(capture)
    assert {key for key in after if after[key] != before[key]} == {"shapes"}


def test_keys_copy_no_photographs_and_skip_missing_views(capture):
    size = (1024, 1024, 3)
    images = [np.ones(size, np.float32) for _ in range(4)]
    nothing = np.broadcast_to(np.float32(np.nan), (60_000, 60_000, 3))
    sensors = [capture.sensors[0]] * 5
    large = memory_capture(capture.scene, images, sensors[:4])
    large = replace(
        large, sensors=tuple(sensors), images=(*large.images, nothing), masks=(None,) * 5,
        used=(True,) * 4 + (False,), exposures=(1.0,) * 5,
    )  # fmt: skip
    capture_key(large)
    assert peak_memory(lambda: capture_key(large)) < images[0].nbytes


def test_object_without_digest_is_refused():
    with pytest.raises(TypeError, match="object has no digest"):
        Key().add([{"a": object()}])


def test_lists_and_numbers_do_not_run_together():
    digests = [Key(*values).digest() for values in (
        ([1], [2]), ([1, 2], []), ([1, 2],), (1, 2), ([[1], 2],), ({"1": 2},), (12,), ("12",),
        (12.0,), (np.array(12),), (np.array([12]),), (np.array(12.0),), (None,), (),
        (["1", 2],), ({},), ({"1": 2, "3": 4},), ({"1": 2}, {"3": 4}), ({"1": 2}, ["3", 4]),
    )]  # fmt: skip
    assert len(set(digests)) == len(digests)


def test_a_normal_that_nearly_cancels_is_content_if_it_was_chosen():
    """At a sharp fold, where the sum of the normals of both sides has the length 1.5e-4."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, 1, 1.5e-4]])
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    sides = np.array([[0, 0, 1], [0, 1.5e-4, -1.0]])
    computed = np.stack([sides.sum(axis=0) / 1.5e-4, sides.sum(axis=0) / 1.5e-4, *sides])
    for normals, expected in ((computed, True), (np.array([[0.0, 0, 1]] * 2 + [*sides]), False)):
        fold = make_mesh("fold", MeshArrays(points, faces, normals, None))
        assert _are_computed(fold, normals.ravel()) == expected


def test_digests_of_files_are_those_of_blake2b_with_128_bits(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")  # b2sum -l 128
    expected = "cf4ab791c62b8d2b2109c90275287816"
    assert digest_of_file(tmp_path / "a") == digest_of(b"abc") == expected


def test_computed_normals_do_not_change_the_capture_key(scene, tmp_path):
    """The mesh of the object has no normals in its file; Mitsuba computes them at every start."""
    options = ReferenceOptions(2, PrincipledGrid(2, 2, 2), 0.5, 2, "linear", 0)
    text = scene.read_text().replace('<string name="filename" value="ball.ply"/>', (
        '<string name="filename" value="other.ply"/>'
    ))  # fmt: skip
    path = scene.with_name("computed.xml")
    path.write_text(text)
    keys = set()
    for _ in range(3):
        capture = load_capture(path, shape="ball")
        layout = svu.texels(capture.mesh, (8, 8))
        content = recovery_digests(capture, layout, None, False, None)
        keys.add(
            (reference_cache.locate(tmp_path, capture, layout, 5, options).name, *content.values())
        )
    assert len(keys) == 1


@pytest.fixture(scope="module")
def kept(capture, tmp_path_factory):
    path = tmp_path_factory.mktemp("kept") / "checkpoint.npz"
    recover(capture, path)
    return path


def recover(capture, path, **options):
    steps = DescentOptions(steps=2)
    brief = replace(SH_PRESETS["default"], smoothing=steps, descent=steps)
    grid = svu.texels(capture.mesh, (8, 8))
    return svu.recover(capture, grid, sh=brief, checkpoint=path, **options)


@pytest.mark.parametrize(
    "change",
    ["field of view", "principal point", "other shape", "integrator depth", "distribution"],
)
def test_a_resumed_run_says_in_words_what_has_changed(scene, kept, change):
    old, new, part = CHANGES[change]
    path = scene.with_name("resumed.xml")
    path.write_text(scene.read_text().replace(old, new))
    with pytest.raises(OptionError, match="belongs to another run") as caught:
        recover(load_capture(path), kept, resume=True)
    assert f"(changed since: {part})" in str(caught.value)
    assert str(kept) in str(caught.value)


def test_a_run_that_did_not_change_goes_on(scene, kept):
    assert len(recover(load_capture(scene), kept, resume=True).losses) == 2
