"""Recovery from end to end, on small captures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import as_tensor, launched_kernels, render_ball

import svu_mi as svu
from svu_mi.capture.capture import Capture
from svu_mi.errors import OptionError, ShapeError, SvuError
from svu_mi.geometry.texels import Texels
from svu_mi.posterior import calibrated_kernel as kernel
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.recovery.initialisation import posterior_means
from svu_mi.recovery.recovery_options import SH_PRESETS, DescentOptions, ShOptions
from svu_mi.recovery.sh.likelihood import Likelihood, QuadraticPrior, texel_moments, values_of
from svu_mi.recovery.svbrdf_textures import Textures, lay_out, uniform_textures
from svu_mi.statistics.gather_statistics import Weighting

SIZE = 24
TRUE: dict[str, Any] = {"base_color": (0.7, 0.4, 0.15), "roughness": 0.5, "metallic": 1.0}
OTHER: dict[str, Any] = {"base_color": (0.1, 0.25, 0.6), "roughness": 0.3, "metallic": 0.0}


def sky() -> dict[str, Any]:
    """A dim sky with a warm lamp and a cool one."""
    image = np.full((32, 64, 3), 0.25, np.float32)
    image[8:11, 10:14] = (14, 10, 6)
    image[14:18, 40:46] = (3, 5, 8)
    return {"type": "envmap", "bitmap": mi.Bitmap(image)}


def striped() -> dict[str, np.ndarray]:
    """Return two materials in stripes, (H, W, C) by name."""
    stripe = (np.arange(SIZE) // 3 % 2 == 0)[None, :, None]
    return {
        name: np.broadcast_to(
            np.where(stripe, np.atleast_1d(TRUE[name]), np.atleast_1d(OTHER[name])),
            (SIZE, SIZE, len(np.atleast_1d(TRUE[name]))),
        ).astype(np.float32)
        for name in TRUE
    }


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    bsdf: dict[str, Any] = {"type": "principled"}
    for name, image in striped().items():
        bsdf[name] = {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(image)),
                      "raw": True, "filter_type": "nearest"}  # fmt: skip
    folder = tmp_path_factory.mktemp("ball")
    return render_ball(folder, sky(), bsdf, views=24, resolution=(96, 96), spp=16)


@pytest.fixture(scope="module")
def grid(capture: Capture) -> Texels:
    return svu.texels(capture.mesh, SIZE)


@pytest.fixture(scope="module")
def truth(grid: Texels) -> Textures:
    index = grid.index.numpy()
    return lay_out(grid, {
        name: np.squeeze(image.reshape(-1, image.shape[2])[index])
        for name, image in striped().items()
    })  # fmt: skip


def psnr(textures: Textures, truth: Textures, grid: Texels) -> float:
    """Return the PSNR of all texels, averaged over the parameters."""
    errors = [
        ((textures.at(grid, name) - truth.at(grid, name)) ** 2).mean() for name, _ in truth.items()
    ]
    return float(np.mean(-10 * np.log10(errors)))


@pytest.fixture(scope="module")
def known(capture: Capture, grid: Texels) -> svu.Estimate:
    return svu.estimate(capture, grid)


@pytest.fixture(scope="module")
def shared(known: svu.Estimate) -> svu.Recovery:
    return svu.recover(known, sharing=True)


@pytest.fixture(scope="module")
def alone(capture: Capture, grid: Texels) -> svu.Recovery:
    return svu.recover(capture, grid)


def test_recovery_finds_the_true_textures(
    alone: svu.Recovery, truth: Textures, grid: Texels
) -> None:
    assert psnr(alone.textures, truth, grid) > psnr(uniform_textures(grid), truth, grid) + 6
    assert alone.losses[-1] < alone.losses[0]
    assert (alone.coverage > 0).mean() > 0.9
    for _, tensor in alone.textures.items():
        values = np.array(tensor)
        assert np.isfinite(values).all()
        assert values.min() >= 0
        assert values.max() <= 1


@pytest.mark.slow
def test_default_preset_beats_the_papers(
    capture: Capture, alone: svu.Recovery, truth: Textures, grid: Texels
) -> None:
    paper = svu.recover(capture, grid, preset="paper")
    assert psnr(alone.textures, truth, grid) > psnr(paper.textures, truth, grid) + 1


def test_sharing_separates_repeated_materials(
    shared: svu.Recovery, alone: svu.Recovery, truth: Textures, grid: Texels
) -> None:
    assert psnr(shared.textures, truth, grid) > psnr(alone.textures, truth, grid) + 0.5
    assert shared.estimate is not None
    assert alone.estimate is not None
    metal = truth.at(grid, "metallic") > 0.5
    prior = shared.estimate.posterior.prior
    r, m = (round(7 * TRUE[name]) for name in ("roughness", "metallic"))
    assert prior.sum(axis=2)[r - 1 : r + 2, m].sum() > 0.5 * metal.mean()
    sure = [np.array(x.estimate.posterior.sd("metallic")).mean() for x in (alone, shared)]
    assert sure[1] < sure[0]


@pytest.mark.slow
def test_recovery_continues_from_an_estimate(known: svu.Estimate, alone: svu.Recovery) -> None:
    """The result equals a recovery from the capture, for other presets and methods, too."""
    again = svu.recover(known)
    assert again.estimate is known
    for name, tensor in alone.textures.items():
        np.testing.assert_array_equal(np.array(tensor), np.array(getattr(again.textures, name)))
    for method, preset in (("angular", "fast"), ("angular", "fixed"), ("spectrum", "paper")):
        other = svu.estimate(known, method=method, preset=preset)  # type: ignore[arg-type]
        recovered = svu.recover(other, sh=brief())
        assert isinstance(recovered.estimate.posterior.kernel, CalibratedKernel)
        assert recovered.settings["estimate"]["method"] == method


@pytest.mark.slow
def test_known_parameters_of_an_estimate_stay_fixed(capture: Capture, grid: Texels) -> None:
    for name, value, preset in (
        ("metallic", 1.0, "default"), ("roughness", 0.5, "fixed"), ("base_color", 0.4, "default")
    ):  # fmt: skip
        known = svu.estimate(capture, grid, known={name: value}, preset=preset)
        recovery = svu.recover(known, sh=brief(), sharing=True)
        assert name not in recovery.settings["parameters"]
        for other in TRUE:
            values = recovery.textures.at(grid, other)
            assert np.isfinite(values).all()
            assert np.allclose(values, value) == (other == name)
    known = svu.estimate(capture, grid, known={"metallic": 0.0})
    with pytest.raises(OptionError, match="fixes all parameters to recover"):
        svu.recover(known, parameters=["metallic"])


def only_metals() -> np.ndarray:
    prior = np.zeros((8, 8, 8))
    prior[3:, 7] = 1
    return prior


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "robust"), [("default", 0), ("fast", 1), ("fixed", 0)])
def test_prior_of_the_estimate_is_kept(
    capture: Capture, grid: Texels, preset: str, robust: int
) -> None:
    """The prior is kept if the posterior is recomputed."""
    believed = svu.estimate(capture, grid, preset=preset, prior=only_metals())
    shared = svu.recover(believed, sh=replace(brief(), robust=robust), sharing=True).estimate
    p = np.array(shared.posterior.probabilities)
    assert p[:, :, :7].max() < 1e-6
    assert p[:, :3].max() < 1e-6


def test_sharing_twice_adds_nothing(shared: svu.Recovery) -> None:
    again = svu.recover(shared.estimate, sh=brief(), sharing=True)
    assert again.estimate.posterior is shared.estimate.posterior


def test_nothing_known_is_one_also_where_texels_share(shared: svu.Recovery) -> None:
    """Entropy is relative to the learned prior, per channel."""
    posterior = shared.estimate.posterior
    blind = replace(posterior.kernel.problem, scale=0 * posterior.kernel.problem.scale)
    blind = replace(blind, min_energy=0 * blind.min_energy)
    blind = replace(blind, min_energy=kernel.min_energy(blind, excess=True))
    prior = replace(posterior.kernel, problem=blind, summary=kernel.summarize(blind))
    unseen = replace(posterior, kernel=prior)
    entropy = np.array(unseen.entropy())
    np.testing.assert_allclose(entropy[posterior.observed], 1, atol=5e-3)
    mean = np.array(posterior.mean("base_color"))[~posterior.observed]
    assert len(mean) == 0 or np.ptp(mean[0]) > 0.01


def test_it_starts_from_the_means_of_the_posterior(
    known: svu.Estimate, grid: Texels, truth: Textures
) -> None:
    start = posterior_means(known)
    seen = np.array(known.coverage) > 0
    for name in TRUE:
        mean = np.array(known.posterior.mean(name))
        np.testing.assert_allclose(start.at(grid, name)[seen], mean[seen], atol=1e-6)
        unseen = start.at(grid, name)[~seen]
        np.testing.assert_allclose(unseen, np.broadcast_to(mean[seen].mean(axis=0), unseen.shape),
                                   atol=1e-5)  # fmt: skip
    assert psnr(start, truth, grid) > psnr(uniform_textures(grid), truth, grid)


def test_a_pull_is_a_squared_distance_and_its_gradient() -> None:
    rng, size, seen = np.random.default_rng(3319), 12, np.array([7, 2, 11, 5])
    target, weight = rng.uniform(size=(5, len(seen))), rng.uniform(0, 0.9, (5, len(seen)))
    parts = {"base_color": slice(0, 3), "roughness": slice(3, 4), "metallic": slice(4, 5)}
    rule = QuadraticPrior(mi.UInt32(seen.astype(np.uint32)), *(
        values_of({name: table[part] for name, part in parts.items()}) for table in (target, weight)
    ))  # fmt: skip
    images = {name: rng.uniform(size=(size, n)) for name, n in
              (("base_color", 3), ("roughness", 1), ("metallic", 1))}  # fmt: skip

    def exact(images: dict[str, np.ndarray]) -> float:
        psi = np.concatenate([image[seen] for image in images.values()], axis=1)
        return float((weight.T * (psi - target.T) ** 2).sum(axis=1).mean())

    textures = {name: as_tensor(image.reshape(3, 4, -1)) for name, image in images.items()}
    dr.enable_grad(textures)
    loss = rule(textures)
    assert float(loss[0]) == pytest.approx(exact(images), rel=1e-5)
    dr.backward(loss)
    for name, image in images.items():
        slope = np.array(dr.grad(textures[name])).reshape(image.shape)
        for place in np.ndindex(image.shape):
            ends = []
            for sign in (1, -1):
                moved = {key: value.copy() for key, value in images.items()}
                moved[name][place] += sign * 1e-5
                ends.append(exact(moved))
            assert slope[place] == pytest.approx((ends[0] - ends[1]) / 2e-5, abs=1e-5)


def test_the_likelihood_is_that_of_the_posterior(known: svu.Estimate, grid: Texels) -> None:
    """In nats, from double-precision sums, the posterior's noise and overdispersion."""
    posterior, observed, switches = known.posterior, known.observed, known.preset
    levels = posterior.kernel.problem.factors.roughness
    sums = observed.statistics(
        levels,
        switches,
        3,
        weighting=Weighting(switches.kappa(observed.unit), switches.edges),
    )
    m, c = 0.25, 0.5
    error = sums.errors(np.array([m]), np.array([c]))[:, 3, :, 0, 0].sum(axis=1)
    nats = sums.weight * error / (2 * posterior.kernel.noise**2 * switches.overdispersion)
    constant = {"base_color": c, "roughness": levels[3], "metallic": m}
    tensors = {n: mi.TensorXf(np.full((SIZE, SIZE, 3 if n == "base_color" else 1), v, np.float32))
               for n, v in constant.items()}  # fmt: skip
    # Both contain the errors that no parameters explain.
    assert float(Likelihood.of(posterior, grid)(tensors)[0]) == pytest.approx(nats.mean(), rel=1e-3)


def test_a_pull_is_that_of_the_moments(known: svu.Estimate, grid: Texels) -> None:
    posterior = known.posterior
    means, sds = texel_moments(posterior)
    pull = QuadraticPrior.of(posterior, grid)
    trust = QuadraticPrior.weighted_by_information(posterior, grid)
    seen = posterior.kernel.problem.factors.texel.numpy()
    for name in TRUE:
        for k, (mean, sd) in enumerate(zip(means[name][:, seen], sds[name][:, seen], strict=True)):
            np.testing.assert_allclose(pull.target[name][k].numpy(), mean, atol=1e-6)
            wanted = 0.5 / (sd**2 + 1e-4)
            np.testing.assert_allclose(pull.weight[name][k].numpy(), wanted, rtol=1e-4)
            assert trust.weight[name][k].numpy().max() <= 1
    order = np.argsort(sds["metallic"][0, seen])
    assert np.all(np.diff(trust.weight["metallic"][0].numpy()[order]) <= 1e-6)


def test_known_parameters_stay_as_the_scene_has_them(
    capture: Capture, grid: Texels, truth: Textures
) -> None:
    recovery = svu.recover(capture, grid, parameters=["base_color"])
    for name in ("roughness", "metallic"):
        np.testing.assert_allclose(
            recovery.textures.at(grid, name), truth.at(grid, name), atol=1e-5
        )
    color = [((t.at(grid, "base_color") - truth.at(grid, "base_color")) ** 2).mean()
             for t in (recovery.textures, uniform_textures(grid))]  # fmt: skip
    assert color[0] < 0.2 * color[1]


def test_equal_runs_give_equal_textures(
    capture: Capture, grid: Texels, alone: svu.Recovery
) -> None:
    again = svu.recover(capture, grid)
    for name, tensor in alone.textures.items():
        np.testing.assert_array_equal(np.array(tensor), np.array(getattr(again.textures, name)))


@pytest.mark.slow
def test_a_brighter_exposure_changes_nothing(capture: Capture, grid: Texels) -> None:
    """Radiance and light are multiplied by 4, so the object is the same."""
    options = replace(ShOptions(), descent=DescentOptions(steps=20))
    bright = dict(sky(), scale=4.0)
    emitter = mi.load_dict(bright)
    scene = mi.load_dict({"type": "scene", "light": emitter, "ball": capture.shape}, optimize=False)
    scaled = replace(capture, scene=scene, images=tuple(4 * image for image in capture.images))
    first = svu.recover(capture, grid, sh=options)
    second = svu.recover(scaled, grid, sh=options)
    for name, tensor in first.textures.items():
        other = np.array(getattr(second.textures, name))
        assert np.quantile(np.abs(np.array(tensor) - other), 0.99) < 5e-3


@pytest.mark.slow
def test_robust_passes_resist_a_spoilt_photograph(
    capture: Capture, grid: Texels, truth: Textures
) -> None:
    images = list(capture.images)
    images[3] = np.where(np.isfinite(images[3]), images[3] * 3 + 0.5, images[3])
    spoilt = replace(capture, images=tuple(images))
    plain = svu.recover(spoilt, grid)
    robust = svu.recover(spoilt, grid, sh=ShOptions(robust=2))
    assert psnr(robust.textures, truth, grid) > psnr(plain.textures, truth, grid)


@pytest.mark.slow
def test_no_kernel_is_compiled_after_the_second_run(capture: Capture, grid: Texels) -> None:
    steps = DescentOptions(steps=6)
    options = replace(ShOptions(), smoothing=steps, descent=steps)
    for _ in range(2):
        svu.recover(capture, grid, sh=options, sharing=True)
    with launched_kernels() as kernels:
        svu.recover(capture, grid, sh=options, sharing=True)
    assert not [kernel for kernel in kernels if not kernel["cache_hit"]]


def test_bad_input_is_refused(capture: Capture, grid: Texels) -> None:
    words: dict[str, Any]
    for words, sentence in (
        ({"preset": "best"}, "Unknown preset"),
        ({"method": "nerf"}, "method must be one of sh, path, sh\\+path"),
        ({"parameters": ["albedo"]}, "Unknown parameter 'albedo'"),
        ({"parameters": []}, "name one or more parameters"), ({"resume": True}, "resume"),
        ({"sharing": 0.5}, "sharing must be a GlobalSharing or True or False"),
    ):  # fmt: skip
        with pytest.raises(OptionError, match=sentence):
            svu.recover(capture, grid, **words)
    other = svu.texels(capture.mesh, SIZE // 2)
    with pytest.raises(ShapeError, match="texels"):
        svu.recover(capture, grid, start=uniform_textures(other))
    with pytest.raises(OptionError, match="at least 2 x 2 texels"):
        svu.recover(capture, svu.texels(capture.mesh, (16, 1)))
    with pytest.raises(OptionError, match="unknown map"):
        svu.Recovery.image(svu.recover(capture, other, sh=brief()), "albedo")


def brief() -> ShOptions:
    steps = DescentOptions(steps=2)
    return replace(SH_PRESETS["default"], smoothing=steps, descent=steps)


def test_a_checkpoint_of_another_estimate_is_refused(known: svu.Estimate, tmp_path: Path) -> None:
    kept = tmp_path / "checkpoint.npz"
    svu.recover(known, sh=brief(), checkpoint=kept)
    svu.recover(known, sh=brief(), checkpoint=kept, resume=True)
    other = svu.estimate(known, prior=only_metals())
    with pytest.raises(SvuError, match="changed since: posterior"):
        svu.recover(other, sh=brief(), checkpoint=kept, resume=True)


@pytest.mark.few(1)
@pytest.mark.parametrize("what", ["masks", "sensors", "sharing"])
def test_a_checkpoint_of_another_capture_is_refused(
    capture: Capture, grid: Texels, tmp_path: Path, what: str
) -> None:
    """The photographs are equal; sensors, masks or sharing differ."""
    kept, other = tmp_path / "checkpoint.npz", capture
    svu.recover(capture, grid, sh=brief(), checkpoint=kept)
    svu.recover(capture, grid, sh=brief(), checkpoint=kept, resume=True)
    if what == "masks":
        mask = np.ones(capture.images[0].shape[:2], bool)
        other = replace(capture, masks=(mask, *capture.masks[1:]))
    elif what == "sensors":
        other = replace(capture, sensors=capture.sensors[::-1])
    with pytest.raises(SvuError, match=f"checkpoint.*{what}"):
        svu.recover(other, grid, sh=brief(), sharing=what == "sharing", checkpoint=kept,
                    resume=True)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["coefficients", "spectrum"])
def test_losses_of_the_paper_fall(capture: Capture, grid: Texels, preset: str) -> None:
    recovery = svu.recover(capture, grid, preset=preset)
    assert recovery.losses[-10:].mean() < 0.9 * recovery.losses[0]
