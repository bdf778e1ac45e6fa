"""Angular statistics and their posterior, against the samples they are made of."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import ball_scene, memory_capture, render_ball, write_ball
from oracle import angular as oracle
from oracle import posterior as oracle_posterior

import svu_mi as svu
from svu_mi import scenes
from svu_mi.angular import Statistics, gather, reflection
from svu_mi.capture.poses import sphere_sensors
from svu_mi.errors import OptionError, ShapeError
from svu_mi.interop import owned
from svu_mi.light import light
from svu_mi.options import preset
from svu_mi.pipeline import estimate
from svu_mi.posterior import ParameterGrid, PrincipledGrid, angular_posterior
from svu_mi.reflection.narrow import terms
from svu_mi.visibility import Surface, pack_views, survey
from svu_mi.visibility.hemisphere import as_channels

ROUGHNESS = np.array([0.0, 0.3, 0.6, 1.0])
STUDIO = {"type": "envmap", "filename": str(scenes.FOLDER / "lights" / "studio.exr")}
PAINT = {"type": "principled"}
GLOSSY = {"type": "principled", "base_color": {"type": "rgb", "value": [0.9, 0.7, 0.4]},
          "metallic": 1.0, "roughness": 0.25}  # fmt: skip


def angular(base="default", **switches):
    return preset(base, method="angular", **switches)


# --- statistics against the samples ---------------------------------------------------------


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A ball, and a wall beside it that hides light from some of its texels."""
    wall = mi.ScalarTransform4f().translate([1.6, 0, 0]).rotate([0, 1, 0], -90).scale(1.5)
    return mi.load_dict(
        {
            "type": "scene",
            "light": STUDIO,
            "ball": {
                "type": "ply",
                "filename": str(write_ball(tmp_path_factory.mktemp("wall"))),
                "bsdf": PAINT,
            },
            "wall": {"type": "rectangle", "to_world": wall, "bsdf": {"type": "diffuse"}},
        },
        optimize=False,
    )


def noise_capture(scene, chosen=range(14), seed=60221, size=24, bright=0):
    """Photographs of nothing but noise: no model fits them, every term of the error counts.

    From the chosen ones of 14 places around the ball; nobody sees it from behind the wall.
    """
    rng = np.random.default_rng(seed)
    ball = next(shape for shape in scene.shapes() if shape.id() == "ball")
    places = sphere_sensors(ball, 14, (size, size))
    sensors = [places[index] for index in chosen]
    images = rng.exponential(size=(len(sensors), size, size, 3)).astype(np.float32)
    if bright:
        images[rng.random(images.shape[:3]) < 0.1] *= bright
    return memory_capture(scene, list(images), sensors, shape=ball, mesh=ball)


def stored_samples(views, surface, model, scale):
    """What ``gather`` sees, as float64 arrays.

    Returns:
        seen (V, T), w (V, T), b (V, C, T), and e, p, q as (V, R, C, T).
    """
    columns = []
    normal, found = mi.Vector3f(surface.normal), survey(views, surface, skip_blind=False)
    for view in range(views.number):
        seen = found.look(views, surface, dr.opaque(mi.UInt32, view))
        mirror = 2 * dr.dot(normal, seen.direction) * normal - seen.direction
        free = dr.dot(surface.geometric_normal, mirror) > 0
        origin = surface.position + surface.offset * surface.geometric_normal
        free &= ~views.scene.ray_test(mi.Ray3f(origin, mirror))
        cosine = dr.maximum(seen.cosine, 1e-3)
        part = terms(model, normal, seen.direction, cosine, free)
        b = as_channels(seen.radiance, model.channels)
        dr.eval(seen, b, part.diffuse, part.scaled, part.added)
        fields = [
            np.array([[np.broadcast_to(x.numpy(), surface.count) for x in row] for row in table])
            for table in (part.diffuse, part.scaled, part.added)
        ]
        columns.append((seen.seen.numpy(), np.array([x.numpy() for x in b]), *fields))
    seen, *fields = (np.array(column) for column in zip(*columns, strict=True))
    b, e, p, q = (np.asarray(field, np.float64) for field in fields)
    w = seen.astype(np.float64)
    if model.switches.noise == "heteroscedastic":
        w /= 1 + (b.mean(axis=1) / scale) ** 2
    return seen, w, b, e, p, q


def tables(statistics):
    """(R, C, 6, T) factor and (C, T) least, float64."""
    size = statistics.levels * statistics.channels * 6
    values = np.array(statistics.values, np.float64).reshape(-1, statistics.count)
    shape = (statistics.levels, statistics.channels, 6, statistics.count)
    return values[:size].reshape(shape), values[size:]


def predicted_error(statistics, level, channel, texel, Kd, R0):
    """|U (Kd, R0) - z|^2 + floor + least."""
    factors, least = tables(statistics)
    u_ee, u_ep, u_pp, z_e, z_p, floor = factors[level, channel, :, texel]
    first, second = u_ee * Kd + u_ep * R0 - z_e, u_pp * R0 - z_p
    return first**2 + second**2 + floor + least[channel, texel]


def setup(capture, switches, roughness=ROUGHNESS, resolution=16):
    """Views, surface, model of a capture's ball."""
    views = pack_views(capture)
    surface = Surface.of(svu.texels(capture.mesh, resolution))
    model = reflection(views.scene, surface, light(capture, 12), roughness, switches)
    return views, surface, model


def worst_error(capture, switches, scale=1.0, seed=1):
    """Compare what statistics say of random (Kd, R0) with the samples, for all texels.

    Returns:
        Largest relative error of the mean squared error, and largest error of its root as a
        part of the root mean square of the photographs: rounding is that of radiance.
    """
    rng = np.random.default_rng(seed)
    views, surface, model = setup(capture, switches)
    statistics = gather(views, surface, survey(views, surface), model, dr.opaque(mi.Float, scale))
    seen, w, b, e, p, q = stored_samples(views, surface, model, scale)
    counts = np.array(statistics.views)
    np.testing.assert_array_equal(counts, seen.sum(axis=0))
    worst = np.zeros(2)
    for texel in np.flatnonzero(counts > 0):
        on = seen[:, texel]
        for level in range(len(ROUGHNESS)):
            for channel in range(model.channels):
                Kd, R0 = rng.random(2)
                columns = (x[on, level, channel, texel] for x in (e, p, q))
                exact = oracle.mean_squared_error(
                    w[on, texel], *columns, b[on, channel, texel], Kd, R0
                )
                ours = predicted_error(statistics, level, channel, texel, Kd, R0)
                size = np.sqrt(np.mean(w[on, texel] * b[on, channel, texel] ** 2))
                root = abs(np.sqrt(ours) - np.sqrt(exact)) / size
                worst = np.maximum(worst, [abs(ours - exact) / exact, root])
    return worst


MODELS = [
    angular(),
    angular(channels="joint"),
    angular(noise="heteroscedastic"),
    angular("fast", channels="joint", noise="heteroscedastic"),
    angular("paper"),
    angular("paper", fresnel="none"),
]


def assert_sufficient(capture, switches):
    relative, root = worst_error(capture, switches)
    assert relative < 1e-4
    assert root < 5e-6


@pytest.mark.parametrize(
    "switches", MODELS, ids=lambda s: f"{s.name}-{s.channels}-{s.noise}-{s.fresnel}"
)
def test_statistics_are_sufficient(scene, switches):
    """The error of any (Kd, R0) as if all samples had been kept."""
    assert_sufficient(noise_capture(scene), switches)


@pytest.mark.parametrize("noise", [
    "relative", "heteroscedastic",
])  # fmt: skip
def test_a_lamp_in_the_photograph_is_a_sample_like_others(scene, noise):
    assert_sufficient(noise_capture(scene, bright=1e4), angular(noise=noise))


@pytest.mark.parametrize("channels", ["grey", "joint"])
def test_one_view_and_identical_views_are_no_special_case(scene, channels):
    """One sample leaves no residual, identical ones make the columns dependent."""
    assert_sufficient(noise_capture(scene, [0]), angular(channels=channels))
    assert_sufficient(noise_capture(scene, [0] * 5), angular(channels=channels))


def test_texels_nobody_sees_have_no_statistics(scene):
    views, surface, model = setup(noise_capture(scene, [0]), angular())
    statistics = gather(views, surface, survey(views, surface), model, dr.opaque(mi.Float, 1.0))
    unseen = np.array(statistics.views) == 0
    assert unseen.any()
    factors, least = tables(statistics)
    assert (factors[..., unseen] == 0).all()
    assert (least[:, unseen] == 0).all()


# --- the posterior against every cell -------------------------------------------------------


def random_samples(rng, texels, channels, levels=5):
    """Samples of shiny and dull texels: w (T, V), b (T, C, V), e, p, q (T, R, C, V)."""
    views = int(rng.integers(4, 9))
    e = rng.random((texels, 1, channels, 1)) * (0.8 + 0.4 * rng.random((texels, levels, 1, views)))
    s = rng.exponential(size=(texels, levels, channels, views))
    f = 0.3 * rng.random((texels, 1, 1, views))
    p, q = s * (1 - f), s * f
    Kd, R0 = rng.random((2, texels, channels, 1))
    true = rng.integers(0, levels, texels)
    b = Kd * e[np.arange(texels), true] + R0 * p[np.arange(texels), true]
    b += q[np.arange(texels), true]
    b *= np.exp(0.1 * rng.normal(size=b.shape))
    return rng.random((texels, views)) + 0.5, b, e, p, q


def compress(w, b, e, p, q, counts=None):
    """``Statistics`` of stored samples, by a QR factorisation of each texel's."""
    texels, levels, channels, _ = e.shape
    factors = np.zeros((levels, channels, 6, texels))
    for t in range(texels):
        root = np.sqrt(w[t] / len(w[t]))
        for r in range(levels):
            for c in range(channels):
                columns = np.stack([e[t, r, c], p[t, r, c], b[t, c] - q[t, r, c]], axis=1)
                R = np.linalg.qr(root[:, None] * columns, mode="r")
                R *= np.where(np.diag(R) < 0, -1, 1)[:, None]
                factors[r, c, :, t] = [*R[0, :2], R[1, 1], R[0, 2], R[1, 2], R[2, 2] ** 2]
    least = factors[:, :, 5].min(axis=0)
    factors[:, :, 5] -= least
    values = np.concatenate([factors.ravel(), least.ravel()])
    counts = np.full(texels, w.shape[1]) if counts is None else counts
    return Statistics(
        values=owned(mi.Float, values.astype(np.float32)),
        views=owned(mi.UInt32, counts.astype(np.uint32)),
        levels=levels,
        channels=channels,
        count=texels,
    )


PRINCIPLED = PrincipledGrid(roughness=5, metallic=3, base_color=4)
SPECULAR = ParameterGrid(roughness=5, specular=6, spacing="dielectric")
SCALE = 0.7
RULES = [
    angular(parameters=parameters, channels=channels, noise=noise, sigma=sigma)
    for parameters in ("principled", "specular")
    for channels in ("grey", "joint")
    for noise, sigma in (
        ("relative", 0.15), ("fixed", 0.3), ("heteroscedastic", 0.04), ("marginal", 0.1)
    )
]  # fmt: skip


def rule(switches):
    return f"{switches.parameters}-{switches.channels}-{switches.noise}"


def grid_of(switches):
    return PRINCIPLED if switches.parameters == "principled" else SPECULAR


def brute_force(switches, samples, views, prior=None):
    """(*grid, C) probabilities of one texel, and the index of the best cell by channel."""
    w, b, e, p, q = samples
    grid = grid_of(switches)
    energies = []
    for c in range(e.shape[1]):
        arguments = (w, e[:, c], p[:, c], q[:, c], b[c])
        if switches.parameters == "principled":
            d = oracle.principled_errors(*arguments, np.linspace(0, 1, 3), np.linspace(0, 1, 4))
        else:
            d = oracle.specular_errors(*arguments, oracle_posterior.nodes(5, 6, "dielectric")[1])
        sigma = switches.sigma * (1 if switches.noise == "fixed" else SCALE)
        energies.append(oracle.energies(d, sigma, views if switches.noise == "marginal" else None))
    together = oracle.joint(energies, prior)
    row, *own = np.unravel_index(together.argmax(), together.shape)
    shared = np.unravel_index(row, grid.shape[:-1])
    return oracle.of_channels(together, grid.shape), [(*shared, k) for k in own]


def random_prior(rng, grid):
    """Weights with holes, one of them a whole roughness."""
    prior = rng.random(grid.shape) * (rng.random(grid.shape) > 0.3)
    prior[2] = 0
    return prior


@pytest.mark.parametrize("with_prior", [False, True], ids=["uniform", "prior"])
@pytest.mark.parametrize("switches", RULES, ids=rule)
def test_every_rule_agrees_with_brute_force(switches, with_prior):
    """Probabilities, entropy, marginals and the most probable cell."""
    rng = np.random.default_rng(141421)
    channels, grid = 3 if switches.channels == "joint" else 1, grid_of(switches)
    samples = random_samples(rng, 8, channels)
    counts = rng.integers(1, 40, 8)
    prior = random_prior(rng, grid) if with_prior else None
    posterior = angular_posterior(compress(*samples, counts), grid, SCALE, switches, prior=prior)
    p = np.array(posterior.probabilities, np.float64).reshape(8, *grid.shape, channels)
    H = np.array(posterior.entropy())
    best = posterior.map()
    for t in range(8):
        truth, cells = brute_force(switches, [x[t] for x in samples], counts[t], prior)
        np.testing.assert_allclose(p[t], truth, atol=5e-6)
        assert abs(H[t] - oracle.mean_entropy(truth)) < 5e-6
        for axis, (name, nodes) in enumerate(grid.axes.items()):
            others = tuple(k for k in range(len(grid.shape)) if k != axis)
            marginal = truth.sum(axis=others)
            ours = np.array(posterior.marginal(name))[t].reshape(len(nodes), -1)
            np.testing.assert_allclose(ours, marginal[:, : ours.shape[1]], atol=1e-5)
            value = np.array(best[name])[t].ravel()
            found = nodes[[cell[axis] for cell in cells]][: len(value)]
            np.testing.assert_allclose(value, found, atol=1e-6)


@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 1e-1, 10.0, 1e4])
@pytest.mark.parametrize("channels", ["grey", "joint"])
def test_entropy_is_exact_for_sharp_and_flat_likelihoods(channels, sigma):
    switches = angular(channels=channels, sigma=sigma)
    samples = random_samples(np.random.default_rng(173205), 12, 3 if channels == "joint" else 1)
    H = np.array(angular_posterior(compress(*samples), PRINCIPLED, SCALE, switches).entropy())
    for t in range(12):
        truth, _ = brute_force(switches, [x[t] for x in samples], 9)
        assert abs(H[t] - oracle.mean_entropy(truth)) < 2e-5


@pytest.mark.parametrize("switches", RULES, ids=rule)
def test_entropy_is_that_of_the_probabilities(switches):
    samples = random_samples(
        np.random.default_rng(223606), 40, 3 if switches.channels == "joint" else 1
    )
    posterior = angular_posterior(compress(*samples), grid_of(switches), SCALE, switches)
    p = np.array(posterior.probabilities, np.float64)
    p = p.reshape(40, *posterior.grid.shape, posterior.groups)
    truth = [oracle.mean_entropy(x) for x in p]
    np.testing.assert_allclose(np.array(posterior.entropy()), truth, atol=3e-6)


@pytest.mark.parametrize("switches", RULES, ids=rule)
def test_a_texel_nobody_saw_has_entropy_exactly_1(switches):
    samples = random_samples(
        np.random.default_rng(244948), 9, 3 if switches.channels == "joint" else 1
    )
    counts = np.array([0, 5, 1] * 3)
    posterior = angular_posterior(compress(*samples, counts), grid_of(switches), SCALE, switches)
    H, p = np.array(posterior.entropy()), np.array(posterior.probabilities)
    assert (H[counts == 0] == 1).all()
    np.testing.assert_allclose(p[counts == 0], 1 / np.prod(posterior.grid.shape), rtol=1e-6)
    assert (H[counts > 0] < 1).all()


@pytest.mark.parametrize("switches", RULES, ids=rule)
@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-3, 1e6, 1e9])
def test_entropy_is_in_0_1_and_nothing_is_nan_at_any_radiance(switches, size):
    """Black photographs, and ones as bright as the sun, in front of the same noise."""
    w, b, e, p, q = random_samples(
        np.random.default_rng(264575), 6, 3 if switches.channels == "joint" else 1
    )
    posterior = angular_posterior(
        compress(w, b * size, e, p, q), grid_of(switches), SCALE, switches
    )
    H, p = np.array(posterior.entropy()), np.array(posterior.probabilities)
    assert ((H >= 0) & (H <= 1)).all()
    assert np.isfinite(p).all()
    np.testing.assert_allclose(p.reshape(6, -1).sum(axis=1), posterior.groups, rtol=1e-5)


@pytest.mark.parametrize("noise", ["relative", "marginal", "heteroscedastic"])
def test_the_unit_of_radiance_does_not_matter(noise):
    w, b, e, p, q = random_samples(np.random.default_rng(282842), 30, 1)
    switches = angular(noise=noise)
    before, after = (
        np.array(angular_posterior(compress(w, b * g, e * g, p * g, q * g), PRINCIPLED,
                                   SCALE * g, switches).entropy())
        for g in (1, 2**10)
    )  # fmt: skip
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_more_of_the_same_views_do_not_make_the_model_better():
    """The error is the model's: it is not averaged away, as the photographs' noise would be."""
    w, b, e, p, q = random_samples(np.random.default_rng(316227), 20, 1)
    many = [np.concatenate([x] * 10, axis=-1) for x in (w, b, e, p, q)]
    H, again = (np.array(angular_posterior(compress(*x), PRINCIPLED, SCALE).entropy())
                for x in ((w, b, e, p, q), many))  # fmt: skip
    np.testing.assert_allclose(again, H, atol=1e-5)
    marginal = angular(noise="marginal")
    H, again = (np.array(angular_posterior(compress(*x), PRINCIPLED, SCALE, marginal).entropy())
                for x in ((w, b, e, p, q), many))  # fmt: skip
    assert again.mean() < H.mean() - 0.05


def test_wrong_input_is_named():
    statistics = compress(*random_samples(np.random.default_rng(3), 2, 1))
    with pytest.raises(ShapeError, match="8 roughness nodes, but the statistics 5"):
        angular_posterior(statistics)
    with pytest.raises(OptionError, match="need a PrincipledGrid"):
        angular_posterior(statistics, SPECULAR)
    with pytest.raises(OptionError, match="scale must be positive"):
        angular_posterior(statistics, PRINCIPLED, 0.0)
    with pytest.raises(ShapeError, match=r"the prior must be \(5, 3, 4\)"):
        angular_posterior(statistics, PRINCIPLED, prior=np.ones((5, 3)))
    with pytest.raises(OptionError, match="non-negative"):
        angular_posterior(statistics, PRINCIPLED, prior=-np.ones(5))
    with pytest.raises(OptionError, match="Unknown switch 'lobes'"):
        angular(lobes="ggx")


# --- from photographs to entropy ------------------------------------------------------------


@pytest.fixture(scope="module")
def glossy(tmp_path_factory):
    """A metal ball in a studio."""
    return render_ball(
        tmp_path_factory.mktemp("angular"), STUDIO, GLOSSY, views=12, resolution=(32, 32), spp=16
    )


@pytest.mark.parametrize("channels", ["grey", "joint"])
def test_statistics_and_posterior_together_are_brute_force(scene, channels):
    """From photographs to the entropy, with a loop over stored samples in the middle."""
    switches = angular(channels=channels, sigma=0.4)
    grid = PrincipledGrid(roughness=4, metallic=3, base_color=3)
    views, surface, model = setup(noise_capture(scene), switches, grid.roughness_nodes)
    statistics = gather(views, surface, survey(views, surface), model, dr.opaque(mi.Float, 1.0))
    H = np.array(angular_posterior(statistics, grid, 1.0, switches).entropy())
    seen, w, b, e, p, q = stored_samples(views, surface, model, 1.0)
    for t in np.flatnonzero(seen.any(axis=0))[::12]:
        on = seen[:, t]
        energies = [
            oracle.energies(oracle.principled_errors(
                w[on, t], *(x[on, :, c, t].T for x in (e, p, q)), b[on, c, t],
                np.linspace(0, 1, 3), np.linspace(0, 1, 3),
            ), 0.4)
            for c in range(model.channels)
        ]  # fmt: skip
        truth = oracle.of_channels(oracle.joint(energies), grid.shape)
        assert abs(H[t] - oracle.mean_entropy(truth)) < 5e-6


@pytest.mark.parametrize("gain", [0.25, 4.0])
@pytest.mark.parametrize("noise", ["relative", "heteroscedastic", "marginal"])
def test_exposure_does_not_matter(tmp_path, glossy, noise, gain):
    brighter_scene = ball_scene(tmp_path, {**STUDIO, "scale": gain}, GLOSSY)
    brighter = replace(
        glossy,
        scene=brighter_scene,
        shape=brighter_scene.shapes()[0],
        images=tuple(image * np.float32(gain) for image in glossy.images),
    )
    texels, switches = svu.texels(glossy.mesh, 20), angular(noise=noise)
    a, b = (np.array(estimate(c, texels, preset=switches).entropy) for c in (glossy, brighter))
    np.testing.assert_allclose(a, b, atol=1e-4)


def test_every_result_is_in_range_and_unseen_texels_are_1(scene):
    capture = noise_capture(scene, [0, 4], bright=1e4)
    texels = svu.texels(capture.mesh, 20)
    for switches in (angular(), angular(channels="joint", parameters="specular")):
        result = estimate(capture, texels, preset=switches)
        H, seen = np.array(result.entropy), np.array(result.coverage) > 0
        assert np.isfinite(H).all()
        assert ((H >= 0) & (H <= 1)).all()
        assert (H[~seen] == 1).all()
        assert (~seen).any()


def kernels_of(capture, resolution, switches, lit_for=12):
    """Hashes of the kernels from occlusion to entropy, and those that had to be compiled."""
    views = pack_views(capture)
    surface = Surface.of(svu.texels(capture.mesh, resolution))
    lighting = light(capture, lit_for)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        model = reflection(views.scene, surface, lighting, np.linspace(0, 1, 8), switches)
        found, scale = survey(views, surface), dr.opaque(mi.Float, 1.0 / capture.count)
        statistics = gather(views, surface, found, model, scale)
        dr.eval(angular_posterior(statistics, None, 0.3, switches).entropy())
        history = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    return {k["hash"] for k in history}, [k for k in history if not k["cache_hit"]]


@pytest.mark.parametrize("noise", ["relative", "heteroscedastic", "marginal"])
@pytest.mark.parametrize("channels", ["grey", "joint"])
def test_other_captures_run_the_same_kernels(tmp_path, scene, channels, noise):
    """Other objects, photographs, number of views, film size and number of texels."""
    switches = angular(channels=channels, noise=noise)
    first, _ = kernels_of(noise_capture(scene), 20, switches)
    other = noise_capture(ball_scene(tmp_path, {**STUDIO, "scale": 3.0}, GLOSSY), range(5), size=20)
    second, compiled = kernels_of(other, 29, switches)
    assert second == first
    assert not compiled


def test_light_for_many_views_runs_the_same_kernels(scene):
    """The degree that is kept of the light grows with the views; kernels do not see it."""
    first, _ = kernels_of(noise_capture(scene), 20, angular())
    second, _ = kernels_of(noise_capture(scene), 20, angular(), lit_for=150)
    assert second == first


def test_a_map_of_another_size_runs_the_same_kernels(tmp_path, scene):
    first, _ = kernels_of(noise_capture(scene), 20, angular())
    sky = ball_scene(tmp_path, {"type": "constant", "radiance": 0.7}, GLOSSY)
    second, _ = kernels_of(noise_capture(sky), 20, angular())
    assert second == first
