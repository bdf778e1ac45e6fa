"""Photographs of an object with another BSDF give the nearest parameters of ``principled``."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from support.helpers import STUDIO, render_ball

import svu_mi as svu


def test_rough_conductor_is_a_metal(tmp_path):
    """Its base colour is its normal reflectance, its roughness the root of alpha."""
    chrome = {"type": "roughconductor", "material": "Cr", "distribution": "ggx", "alpha": 0.2}
    capture = render_ball(tmp_path, STUDIO, chrome, views=16, resolution=(40, 40), spp=32)
    estimate = svu.estimate(capture, svu.texels(capture.mesh, 12), preset="default")
    seen = np.array(estimate.coverage) >= 4
    assert seen.sum() > 20
    color, roughness, metallic = (
        np.median(np.array(estimate.posterior.mean(name))[seen], axis=0)
        for name in ("base_color", "roughness", "metallic")
    )
    params = mi.traverse(mi.load_dict(chrome))
    eta, k = (np.array(params[f"{name}.value"], np.float64).ravel() for name in ("eta", "k"))
    np.testing.assert_allclose(color, ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2), atol=0.08)
    assert abs(roughness - 0.2**0.5) < 0.08
    assert metallic > 0.9
