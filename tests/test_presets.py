"""Presets of the estimators: used as they are, and bad switches refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.helpers import render_ball

import svu_mi as svu
from svu_mi import pipeline, scenes
from svu_mi.errors import OptionError
from svu_mi.posterior import estimators
from svu_mi.presets import METHODS, AngularPreset, preset

NAMES = [(method, name) for method, (_, named) in METHODS.items() for name in named]


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    light = {"type": "envmap", "filename": str(scenes.FOLDER / "lights" / "studio.exr")}
    paint = {"type": "principled", "roughness": 0.4, "metallic": 1.0}
    capture = render_ball(
        tmp_path_factory.mktemp("ball"), light, paint, views=6, resolution=(24, 24)
    )
    return svu.estimate(capture, svu.texels(capture.mesh, 8))


@pytest.mark.few(4)
@pytest.mark.parametrize(("method", "name"), NAMES)
def test_an_estimate_uses_its_preset(seen, monkeypatch, method, name):
    """What reaches the model, the fit and the posterior is the preset, with a learned share."""
    used = []
    for module, kind in (
        (estimators, "angular_posterior"), (estimators, "calibrated_posterior"),
        (estimators, "fit"), (pipeline, "spectrum_posterior"), (pipeline, "fit_spectra"),
    ):  # fmt: skip
        real = getattr(module, kind)

        def watch(*given, real=real, **options):
            used.extend(x for x in (*given, *options.values()) if hasattr(x, "colors"))
            return real(*given, **options)

        monkeypatch.setattr(module, kind, watch)
    estimate = svu.estimate(seen, method=method, preset=name)
    assert estimate.preset == preset(name, method=method)
    learned = {"metal_share": None} if getattr(estimate.preset, "metal_share", 0) is None else {}
    assert used and all(replace(one, **learned) == estimate.preset for one in used)
    entropy = np.array(estimate.entropy)
    assert np.isfinite(entropy).all()


@pytest.mark.parametrize(
    ("switches", "sentence"),
    [
        ({"cells": 1024}, "cells must be 0 with a fit"),
        ({"lobe": "ggx"}, "lobe must be 'gaussian' with a fit"),
        ({"fresnel": "split_sum"}, "fresnel must be 'schlick' or 'none' with a fit"),
        ({"off_specular": True}, "off_specular must be False with a fit"),
        ({"occluded": True}, "occluded must be False with a fit"),
        ({"fit": True}, "fit must be a Fit, got True"),
        ({"noise": "estimated"}, "errors='sum' requires noise"),
        ({"errors": "median"}, "errors must be one of mean, sum"),
    ],
)
def test_options_that_contradict_a_fit_are_refused(switches, sentence):
    with pytest.raises(OptionError, match=sentence):
        preset("paper", method="angular", **switches)


@pytest.mark.parametrize("cells", [-1, 1, 255, 4097])
def test_numbers_of_cells_out_of_range_are_refused(cells):
    with pytest.raises(OptionError, match=r"cells must be in \[256, 4096\], or 0"):
        preset("default", method="angular", cells=cells)


@pytest.mark.parametrize(
    "wrong",
    [
        {"errors": "median"},
        {"cells": 256.5},
        {"off_specular": 1},
        {"knee": "all"},
        {"metal_share": "0.5"},
        {"metal_share": 1.0},
        {"metal_share": float("nan")},
    ],
)
def test_types_of_switches_are_checked(wrong):
    with pytest.raises(OptionError, match=f"{next(iter(wrong))} must be"):
        AngularPreset(**wrong)
