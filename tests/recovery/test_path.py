"""Recovery by path tracing: pixels, rays and gradients."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import as_tensor, memory_capture, random_textures, render_ball, render_views

from svu_mi.capture.mesh import arrays
from svu_mi.capture.replace_material import is_same, replace_material
from svu_mi.capture.sensors import describe, film_size, make_sensor
from svu_mi.errors import CaptureError, OptionError, ShapeError
from svu_mi.geometry.packed_views import pack_views
from svu_mi.geometry.texels import texels as lay_texels
from svu_mi.parameters import NAMES
from svu_mi.recovery.adam import descend
from svu_mi.recovery.checkpoint import Checkpoint
from svu_mi.recovery.path.pixel_batches import PixelBatches
from svu_mi.recovery.path.pixel_loss import FLOOR, LOSSES, path_objective
from svu_mi.recovery.path.textured_scene import PathScene
from svu_mi.recovery.recovery_options import DescentOptions, PathOptions
from svu_mi.recovery.svbrdf_textures import Textures, uniform_textures


def light():
    """A smooth sky, warm on one side: not constant, but with little noise."""
    v, u = np.mgrid[0:16, 0:32]
    sky = np.stack([1 + np.cos(u / 32 * 2 * np.pi), 1 + 0 * u, 1.5 - v / 16], axis=-1)
    return {"type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32))}


def paint(base_color=(0.6, 0.4, 0.2), roughness=0.4, metallic=0.3):
    return {"type": "principled", "base_color": {"type": "rgb", "value": list(base_color)},
            "roughness": roughness, "metallic": metallic, "specular": 0.5}  # fmt: skip


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return render_ball(
        tmp_path_factory.mktemp("ball"), light(), paint(), views=6, resolution=(32, 32), spp=256
    )


@pytest.fixture(scope="module")
def grid(capture):
    return lay_texels(capture.mesh, (8, 6))


def options(**changes):
    defaults = {"pixels_per_batch": 256, "spp": 4, "max_depth": 2, "loss": "l2", "tv": 0.0}
    return PathOptions(**{**defaults, **changes})


def textures_of(grid, base_color=(0.6, 0.4, 0.2), roughness=0.4, metallic=0.3):
    width, height = grid.resolution
    one = np.ones((height, width, 1))
    return {"base_color": as_tensor(one * base_color), "roughness": as_tensor(one * roughness),
            "metallic": as_tensor(one * metallic)}  # fmt: skip


# ---- losses ----


@pytest.mark.parametrize("name", LOSSES)
def test_losses_are_their_equations(name):
    rng = np.random.default_rng(3)
    r, y = rng.random((1, 40, 3)), rng.random((1, 40, 3))
    s = 0.3
    wanted = {
        "l1": np.mean(np.abs(r - y)) / s,
        "l2": np.mean((r - y) ** 2) / s**2,
        "relative": np.mean((r - y) ** 2 / (y**2 + (s * FLOOR) ** 2)),
    }[name]
    loss = LOSSES[name](as_tensor(r), as_tensor(y), dr.opaque(mi.Float, s))
    assert np.allclose(np.array(loss), wanted, rtol=1e-5)
    # The same at any exposure.
    brighter = LOSSES[name](as_tensor(7 * r), as_tensor(7 * y), dr.opaque(mi.Float, 7 * s))
    assert np.allclose(np.array(brighter), wanted, rtol=1e-5)


# ---- the scene ----


def test_repainting_does_not_modify_the_capture(capture):
    before = arrays(capture.mesh)
    material = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse"}})
    bsdf = str(capture.shape.bsdf())
    made = replace_material(capture, material)
    assert str(capture.shape.bsdf()) == bsdf
    assert not is_same(made.shape, capture.shape)
    assert len(made.scene.shapes()) == len(capture.scene.shapes())
    assert np.array_equal(arrays(made.shape).uvs, before.uvs)
    assert np.array_equal(arrays(capture.mesh).positions, before.positions)


def test_an_unwrapped_mesh_brings_its_own_uvs(capture):
    from svu_mi.capture.mesh import MeshArrays, make_mesh

    old = arrays(capture.mesh)
    mesh = make_mesh("new", MeshArrays(old.positions, old.faces, old.normals, old.uvs * 0.5))
    made = replace_material(replace(capture, mesh=mesh), mi.load_dict({"type": "diffuse"}))
    assert np.allclose(arrays(made.shape).uvs, old.uvs * 0.5)


def test_two_sided_materials_stay_two_sided(tmp_path):
    both = {"type": "twosided", "bsdf": paint()}
    capture = render_ball(tmp_path, light(), both, views=1, resolution=(8, 8), spp=1)
    assert "TwoSided" in replace_material(capture, mi.load_dict(paint())).shape.bsdf().class_name()


@pytest.mark.slow
def test_uniform_textures_render_as_the_uniform_material(capture, grid):
    """Equal paths, equal radiance: each texture sets its own parameter."""
    target = PathScene.of(capture, uniform_textures(grid))
    for values in ({}, {"metallic": 0.0, "roughness": 0.8}, {"metallic": 1.0, "roughness": 0.2}):
        target.paint(textures_of(grid, **values))
        # Created with 0.5 and painted afterwards, as the textures: no lobe is disabled.
        plain = mi.load_dict(paint((0.5, 0.5, 0.5), 0.5, 0.5))
        params = mi.traverse(plain)
        wanted = {"base_color": (0.6, 0.4, 0.2), "roughness": 0.4, "metallic": 0.3, **values}
        params["base_color.value"] = mi.Color3f(*wanted["base_color"])
        params["roughness.value"] = wanted["roughness"]
        params["metallic.value"] = wanted["metallic"]
        params.update()
        images = [
            np.array(mi.render(scene, sensor=capture.sensors[0], spp=4, seed=1,
                               integrator=mi.load_dict({"type": "prb", "max_depth": 2})))
            for scene in (target.scene, replace_material(capture, plain).scene)
        ]  # fmt: skip
        assert np.allclose(*images, rtol=1e-3, atol=1e-4)


def test_wrong_textures_are_refused(capture, grid):
    target = PathScene.of(capture, uniform_textures(grid))
    with pytest.raises(ShapeError, match="roughness must have shape"):
        target.paint({"roughness": dr.full(mi.TensorXf, 0.5, shape=(6, 8, 3))})


# ---- sensors and batches ----


def odd_sensor(sensor, **changes):
    record = describe(sensor) | {
        "film": [40, 28], "crop_offset": [7, 3], "crop_size": [25, 19],
        "principal_point_offset": [0.06, -0.11],
    } | changes  # fmt: skip
    return make_sensor(record, "odd")


def mixed(capture):
    """Views of several sizes, with a crop, a mask, a hole, and one unused view."""
    sensors = [odd_sensor(capture.sensors[0]), *capture.sensors[1:]]
    images = render_views(capture.scene, sensors, 256)
    images[2][10:14] = np.nan
    masks = [None] * len(sensors)
    masks[3] = np.zeros((32, 32), bool)
    masks[3][8:24, 10:30] = True
    used = (True, True, True, True, False, True)
    return memory_capture(capture.scene, images, sensors, masks=tuple(masks), used=used)


def test_an_epoch_shows_every_usable_pixel_once_and_no_other(capture):
    scene = mixed(capture)
    batches = PixelBatches(scene, 100, seed=7)
    views = pack_views(scene)
    wanted = np.flatnonzero(views.usable.numpy())
    assert batches.pixels == len(wanted)
    assert batches.epoch == -(-len(wanted) // 100)
    orders = []
    for first in (0, batches.epoch):
        drawn = [batches.at(step) for step in range(first, first + batches.epoch)]
        flat = np.concatenate([np.array(batch.index) for batch in drawn])
        view, row, column = (
            np.concatenate([np.array(batch.places[k]) for batch in drawn]) for k in range(3)
        )
        assert len(flat) == 100 * batches.epoch
        assert np.array_equal(np.sort(flat[: len(wanted)]), wanted)
        assert np.array_equal(flat[len(wanted) :], flat[: len(flat) - len(wanted)])
        offset, width = views.offset.numpy()[view], views.width.numpy()[view]
        assert np.array_equal(offset + row * width + column, flat)
        assert (row < views.height.numpy()[view]).all() and (column < width).all()
        orders.append(flat)
    assert not np.array_equal(*orders)
    together = np.mean(np.diff(orders[0].astype(int)) == 1)
    assert 0.5 < together < 0.9


def test_rays_pass_through_their_pixels(capture):
    """Views of several sizes, one with a crop window."""
    scene = mixed(capture)
    batches = PixelBatches(scene, 200)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, 400)
    batch = batches.at(0)
    rays = batch.rays(batches.views, sampler, 2)
    sampler.seed(3, 400)
    jitter = np.array(sampler.next_2d())
    view, row, column = (np.array(place) for place in batch.places)
    kept = np.flatnonzero(scene.used)
    for k in range(0, 400, 13):
        pixel = k // 2
        sensor = scene.sensors[kept[view[pixel]]]
        width, height = film_size(sensor)
        at = (column[pixel] + jitter[0, k]) / width, (row[pixel] + jitter[1, k]) / height
        ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f(*map(float, at)), mi.Point2f(0.5))
        assert np.abs(np.array(rays.o)[:, k] - np.array(ray.o)[:, 0]).max() < 2e-6
        assert np.abs(np.array(rays.d)[:, k] - np.array(ray.d)[:, 0]).max() < 2e-6


def test_a_batch_depends_on_seed_and_step_alone(capture):
    one, other = PixelBatches(capture, 128, seed=3), PixelBatches(capture, 128, seed=3)
    last = 2 * one.epoch + 1
    forward = {step: np.array(one.at(step).index) for step in range(last + 1)}
    for step in (last, 0, one.epoch, 1):
        assert np.array_equal(np.array(other.at(step).index), forward[step])
    another = PixelBatches(capture, 128, seed=4)
    assert not np.array_equal(np.array(another.at(0).index), forward[0])


@pytest.mark.slow
def test_renders_and_photographs_are_of_the_same_pixels(capture, grid):
    """In all views; with the true material, only noise differs."""
    scene = mixed(capture)
    objective = path_objective(scene, grid, options(pixels_per_batch=10**6, spp=512))
    assert objective.batches.size == objective.batches.pixels
    objective.target.paint(textures_of(grid))
    render, photograph, _ = objective._trace(objective.batches.at(0), mi.UInt32(1))
    error = (np.array(render) - np.array(photograph)).reshape(-1, 2, 3).mean(axis=1)
    error /= objective.batches.mean
    # Renders of 256 and 512 paths: errors of about 4 % of the mean, which cancel in a view. A
    # pixel next to the right one differs by 20 %.
    assert np.sqrt(np.mean(error**2)) < 0.08
    view = np.array(objective.batches.at(0).places[0])
    assert np.array_equal(np.unique(view), np.arange(5))
    for index in range(5):
        assert abs(error[view == index].mean()) < 0.01
    assert np.isclose(objective.batches.mean, np.array(photograph).mean(), rtol=1e-5)


def test_no_usable_pixel_is_refused(capture):
    dark = replace(capture, masks=tuple(np.zeros((32, 32), bool) for _ in capture.images))
    with pytest.raises(CaptureError, match="No photograph shows the object"):
        PixelBatches(dark, 64)


# ---- gradients ----


def loss_and_gradients(objective, textures, step=0):
    """Return the loss of a step, and its gradient in all textures."""
    live = {name: mi.TensorXf(value) for name, value in textures.items()}
    dr.enable_grad(*live.values())
    loss = objective(live, step)
    dr.backward(loss)
    return number(loss), {name: np.array(value.grad) for name, value in live.items()}


def number(loss):
    return float(np.array(loss).ravel()[0])


@pytest.mark.slow
@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_are_those_of_finite_differences(capture, grid, loss):
    """Means over many paths; equality is statistical, because gradients use independent paths.

    A random direction gives every texel another weight. Gradients by halves are compared with
    differences of the whole loss.
    """
    plain, halves = (
        path_objective(
            capture, grid, options(loss=loss, spp=256, pixels_per_batch=4096, halves=halves)
        )
        for halves in (False, True)
    )
    at = random_textures(grid.resolution, 0)
    losses, gradients = zip(*(loss_and_gradients(o, at) for o in (plain, halves)), strict=True)
    assert losses[1] == pytest.approx(losses[0], rel=0.03)  # each half is noisier
    h = 0.01  # the error of a central difference falls as h^2, its rounding rises as 1e-7 / h
    for name in NAMES:
        direction = np.random.default_rng(1).uniform(0.5, 1.0, at[name].shape)
        ahead, behind = (
            number(plain({**at, name: as_tensor(np.array(at[name]) + step * direction)}, 0))
            for step in (h, -h)
        )
        wanted = (ahead - behind) / (2 * h)
        for gradient in gradients:
            size = float(np.abs(gradient[name] * direction).sum())
            assert abs((gradient[name] * direction).sum() - wanted) < 0.03 * size, name
            assert abs(wanted) > 0.1 * size  # the noise differs


@pytest.mark.slow
def test_gradient_paths_are_independent_of_the_loss(capture, grid):
    """At the truth, mean gradients of a squared loss are 0 even with two paths."""
    objective = path_objective(capture, grid, options(spp=2, pixels_per_batch=4096))

    truth = textures_of(grid)
    errors = np.array([
        [gradient.sum() for gradient in loss_and_gradients(objective, truth, step)[1].values()]
        for step in range(40)
    ])  # fmt: skip
    error = errors.std(axis=0, ddof=1) / np.sqrt(len(errors))
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * error)


def test_an_odd_number_of_paths_has_no_halves(capture, grid):
    assert path_objective(capture, grid, options(spp=3)).halves == 1
    assert path_objective(capture, grid, options(halves=False)).halves == 1
    assert path_objective(capture, grid, options()).halves == 2


@pytest.mark.slow
def test_fixed_parameters_keep_their_values(capture, grid):
    fixed = Textures(**textures_of(grid))
    objective = path_objective(capture, grid, options(spp=64), fixed=fixed)
    whole = path_objective(capture, grid, options(spp=64))
    some = {"roughness": textures_of(grid, roughness=0.6)["roughness"]}
    pixels = np.array(objective(some, 2))
    wanted = np.array(whole({**dict(fixed.items()), **some}, 2))
    assert np.allclose(pixels, wanted, rtol=1e-5)


# ---- the loop ----


@pytest.mark.slow
def test_descent_finds_the_colour_of_a_surface(capture, grid):
    """Other parameters are known, because few paths do not determine all of them."""
    fixed = Textures(**textures_of(grid))
    objective = path_objective(capture, grid, options(epochs=3, spp=8), fixed=fixed)
    start = {"base_color": uniform_textures(grid).base_color}
    descent = descend(objective, start, DescentOptions(steps=objective.steps, learning_rate=0.04))
    color = np.array(descent.values["base_color"])[1:5].mean(axis=(0, 1))  # off the poles
    assert np.abs(color - (0.6, 0.4, 0.2)).max() < 0.02
    assert descent.losses[-5:].mean() < 0.5 * descent.losses[:3].mean()


@pytest.mark.slow
def test_resumed_run_equals_uninterrupted_run(capture, grid, tmp_path):
    """Except for the order of additions by threads, which Adam's division amplifies."""
    settings = DescentOptions(steps=15, learning_rate=0.01)
    start = dict(uniform_textures(grid).items())
    whole = descend(path_objective(capture, grid, options()), start, settings)
    objective = path_objective(capture, grid, options())

    def stopping(textures, step):
        if step == 8:
            raise KeyboardInterrupt
        return objective(textures, step)

    with pytest.raises(KeyboardInterrupt):
        descend(stopping, start, settings, checkpoint=Checkpoint(tmp_path / "c.npz", {}))
    assert 8 % objective.batches.epoch != 0
    resumed = descend(path_objective(capture, grid, options()), start, settings,
                      checkpoint=Checkpoint(tmp_path / "c.npz", {}, resume=True))  # fmt: skip
    assert np.allclose(resumed.losses, whole.losses, rtol=1e-3)
    for name in NAMES:
        a, b = np.array(resumed.values[name]), np.array(whole.values[name])
        assert np.abs(a - b).max() < 2e-3


@pytest.mark.slow
def test_descent_with_one_thread_is_reproducible(capture, grid):
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        runs = [
            descend(path_objective(capture, grid, options()), dict(uniform_textures(grid).items()),
                    DescentOptions(steps=6))
            for _ in range(2)
        ]  # fmt: skip
    finally:
        dr.set_thread_count(threads)
    assert np.array_equal(runs[0].losses, runs[1].losses)
    for name in NAMES:
        assert np.array_equal(*(np.array(run.values[name]) for run in runs))


@pytest.mark.slow
def test_later_steps_and_epochs_compile_no_kernel(capture, grid):
    objective = path_objective(capture, grid, options(pixels_per_batch=512))
    compiled = {}

    def watched(textures, step):
        dr.sync_thread()
        compiled[step] = dr.detail.launch_stats()[1:]
        return objective(textures, step)

    steps = objective.batches.epoch + 2
    descend(watched, dict(uniform_textures(grid).items()), DescentOptions(steps=steps))
    assert compiled[2] == compiled[steps - 1]


@pytest.mark.parametrize(
    "wrong",
    [{"epochs": 0.0}, {"pixels_per_batch": 0}, {"spp": 0}, {"max_depth": 1}, {"loss": "l3"},
     {"tv": -1.0}, {"tv": np.nan}, {"seed": -1}],
)  # fmt: skip
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(OptionError, match=next(iter(wrong))):
        PathOptions(**wrong)
