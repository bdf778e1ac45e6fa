"""What ``test_parameters.py`` runs in a copy of svu_mi that estimates ``specular``, too."""

from __future__ import annotations

import sys
from pathlib import Path

import svu_mi as svu  # before Mitsuba, so that it chooses the LLVM library

import mitsuba as mi  # isort: skip
import numpy as np
from numpy.testing import assert_allclose

from svu_mi.output.texture_files import write_textures
from svu_mi.posterior.calibrated import CalibratedKernel, calibrated_posterior
from svu_mi.reflection.principled import columns, diffuse_from_principled, specular_from_principled
from svu_mi.scenes import FOLDER
from svu_mi.statistics.cholesky_factors import PAIRS
from svu_mi.statistics.statistics import Statistics

TEXELS, VIEWS = 5, 12
EDGES = np.array([0, 0.25, 0.75, 1])  # of the cells of a grid of three nodes


def parts(count: int, ends: float) -> tuple[np.ndarray, ...]:
    """Middle, width, prior and cell of every part of [0, 1], with ``ends`` shared by 0 and 1."""
    middle = (np.arange(count) + 0.5) / count
    width = np.full(count, 1 / count)
    prior = np.full(count, (1 - ends) / count)
    if ends:
        middle, width = np.r_[0, middle, 1], np.r_[0, width, 0]
        prior = np.r_[ends / 2, prior, ends / 2]
    return middle, width, prior, np.clip(np.searchsorted(EDGES, middle) - 1, 0, 2)


def check_posterior() -> None:
    """Means, deviations and marginals against sums over all samples, parts and colours."""
    rng = np.random.default_rng(5201)
    e, p, q, d = rng.uniform(0.1, 1, (4, VIEWS, TEXELS))
    c, m, s = rng.random((3, TEXELS))
    b = (1 - m) * (c * e + 2 * s * d) + m * (c * p + q) + 0.05 * rng.standard_normal(e.shape)
    x = columns(e, p, q, d, b)
    table = np.stack([(x[i] * x[j]).sum(axis=0) for i, j in PAIRS])[None, None]
    views = np.full(TEXELS, VIEWS)
    grid = svu.PrincipledGrid(metallic=3, base_color=3, specular=3, known={"roughness": 0.5})
    switches = svu.preset("default", method="angular", bare_metals=0.0)
    posterior = calibrated_posterior(
        Statistics.of(table, views, views, np.array([0.5])), grid, preset=switches
    )
    assert specular_from_principled(0.7, 0, 1) == 0.08  # twice the default's, of a dielectric
    assert diffuse_from_principled(0.7, 0, 1) == 0.7
    assert list(posterior.axes) == ["roughness", "metallic", "specular", "base_color"]
    # A multiple of the 4 halves of cells, not below 14.
    metal, gloss, color = parts(16, switches.metals), parts(16, 0), (np.arange(400) + 0.5) / 400
    precision = 1 / (2 * posterior.kernel.noise**2 * switches.overdispersion)
    weight = np.empty((TEXELS, len(metal[0]), len(gloss[0]), len(color)))
    for k, value in enumerate(metal[0]):
        y, colors = gloss[0][:, None, None, None], color[:, None, None]
        shown = value * (colors * p + q) + (1 - value) * (colors * e + 2 * y * d)
        energy = precision * ((shown - b) ** 2).sum(axis=2)  # (gloss, color, T)
        weight[:, k] = np.moveaxis(np.exp(-energy) * metal[2][k], -1, 0)
    weight /= weight.sum(axis=(1, 2, 3), keepdims=True)
    for name, (middle, width, _, cell), axes in (
        ("metallic", metal, (2, 3)), ("specular", gloss, (1, 3)),
    ):  # fmt: skip
        masses = weight.sum(axis=axes)
        mean = masses @ middle
        sd = np.sqrt(masses @ (middle**2 + width**2 / 12) - mean**2)
        marginal = np.stack([masses[:, cell == k].sum(axis=1) for k in range(3)], axis=1)
        assert_allclose(posterior.mean(name).numpy(), mean, atol=2e-4)
        assert_allclose(posterior.sd(name).numpy(), sd, atol=2e-4)
        assert_allclose(posterior.marginal(name).numpy(), marginal, atol=5e-4)
        low, high = (x.numpy() for x in posterior.interval(name))
        for t in range(TEXELS):
            inside = (middle >= low[t]) & (middle <= high[t])
            assert masses[t, inside].sum() > 0.899
    drawn = posterior.draw(2)
    assert drawn["specular"].shape == (2, TEXELS)


def check_recovery(folder: Path) -> None:
    """From photographs to textures and files, with all that a capture goes through."""
    capture = svu.render_capture(FOLDER / "planes" / "planes.xml", spp=2)
    texels = svu.texels(capture.mesh, 16)
    grid = svu.PrincipledGrid(4, 3, 3, specular=3)
    estimate = svu.estimate(capture, texels, grid=grid)
    assert isinstance(estimate.posterior.kernel, CalibratedKernel)
    assert 0 < np.array(estimate.entropy).mean() < 1
    textures = svu.recover(estimate, method="sh").textures
    assert np.array(textures.specular).shape == (16, 16, 1)
    write_textures(textures, folder)
    assert (folder / "specular.exr").is_file()


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    check_posterior()
    check_recovery(Path(sys.argv[1]))
    sys.stdout.write(f"done with {svu.__file__}")
