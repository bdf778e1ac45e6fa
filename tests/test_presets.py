"""Presets of the estimators: every switch written down once more, and used as it stands there."""

from __future__ import annotations

import typing
from dataclasses import asdict, fields
from typing import Any

import numpy as np
import pytest
from helpers import render_ball

import svu_mi as svu
from svu_mi import estimators, scenes
from svu_mi.errors import OptionError
from svu_mi.options import ANGULAR_PRESETS, PRESETS, AngularPreset, preset

SPECTRUM: dict[str, Any] = {
    "degree": 6, "regularizer": 1e-2, "penalize_constant": False, "band_limit": "photographs",
    "undo_prefilter": False, "occluded": True, "rays": 64, "albedo": True,
    "parameters": "principled", "bounded_alpha": True, "spacing": "dielectric", "channels": "grey",
    "noise": "relative", "sigma": 0.004, "constant_sigma": 0.06,
}  # fmt: skip
ANGULAR: dict[str, Any] = {
    "fresnel": "split_sum", "lobe": "ggx", "fit": None, "off_specular": True, "cells": 1024,
    "occluded": True, "diffuse": "disney", "parameters": "principled", "channels": "joint",
    "noise": "estimated", "sigma": 0.08, "errors": "mean", "assumed": 0.02, "overdispersion": 3.5,
    "degrees": 4.0, "knee": 0.5, "edges": 60.0, "metals": 0.8, "levels": 8, "parts": 42,
}  # fmt: skip
WRITTEN: dict[tuple[str, str], dict[str, Any]] = {
    ("spectrum", "default"): SPECTRUM,
    ("spectrum", "fast"): SPECTRUM | {"degree": 4},
    # Eq. 3, 5, 8, 11 to 13 as printed.
    ("spectrum", "paper"): SPECTRUM | {
        "regularizer": 1e-3, "penalize_constant": True, "band_limit": "growing", "occluded": False,
        "albedo": False, "parameters": "specular", "bounded_alpha": False, "spacing": "uniform",
        "channels": "sum", "noise": "fixed", "sigma": 0.1,
    },
    ("angular", "default"): ANGULAR,
    ("angular", "fixed"): ANGULAR | {"channels": "grey", "noise": "relative"},
    ("angular", "fast"): ANGULAR | {"channels": "grey", "cells": 0, "parts": 14},
    # Eq. 3 to 6 and 12 as printed.
    ("angular", "paper"): ANGULAR | {
        "fresnel": "schlick", "lobe": "gaussian", "off_specular": False, "cells": 0,
        "occluded": False, "diffuse": "lambert", "channels": "grey", "noise": "relative",
        "sigma": 0.4, "errors": "sum",
        "fit": {"degree": 6, "regularizer": 1e-3, "penalize_constant": True,
                "undo_prefilter": False},
    },
}  # fmt: skip


def test_presets_are_what_is_written_down():
    methods = {"spectrum": PRESETS, "angular": ANGULAR_PRESETS}
    found = {(method, name): asdict(one) for method in methods
             for name, one in methods[method].items()}  # fmt: skip
    assert found == {asked: {"name": asked[1], **switches} for asked, switches in WRITTEN.items()}


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    light = {"type": "envmap", "filename": str(scenes.FOLDER / "lights" / "studio.exr")}
    paint = {"type": "principled", "roughness": 0.4, "metallic": 1.0}
    capture = render_ball(
        tmp_path_factory.mktemp("ball"), light, paint, views=6, resolution=(24, 24)
    )
    return svu.estimate(capture, svu.texels(capture.mesh, 8))


@pytest.mark.few(4)
@pytest.mark.parametrize(("method", "name"), WRITTEN)
def test_an_estimate_uses_its_preset(seen, monkeypatch, method, name):
    """What reaches the model, the fit and the posterior is the preset itself."""
    used = []
    for kind in ("angular_posterior", "calibrated_posterior", "spectrum_posterior", "fit_spectra"):
        real = getattr(estimators, kind)

        def watch(*given, real=real, **options):
            used.extend(x for x in (*given, *options.values()) if hasattr(x, "colors"))
            return real(*given, **options)

        monkeypatch.setattr(estimators, kind, watch)
    found = svu.estimate(seen, method=method, preset=name)
    assert found.preset == preset(name, method=method)
    assert used and all(one == found.preset for one in used)
    entropy = np.array(found.entropy)
    assert np.isfinite(entropy).all()


@pytest.mark.parametrize(
    ("switches", "sentence"),
    [
        ({"cells": 1024}, "cells must be 0 with a fit"),
        ({"lobe": "ggx"}, "lobe must be 'gaussian' with a fit"),
        ({"fresnel": "split_sum"}, "fresnel must be 'schlick' or 'none' with a fit"),
        ({"off_specular": True}, "off_specular must be False with a fit"),
        ({"occluded": True}, "occluded must be False with a fit"),
        ({"fit": True}, "fit must be a Fit, or None"),
        ({"noise": "estimated"}, "noise='estimated' counts views itself"),
        ({"errors": "median"}, "errors must be one of mean, sum"),
    ],
)
def test_what_the_paper_has_not_is_refused_beside_what_it_has(switches, sentence):
    with pytest.raises(OptionError, match=sentence):
        preset("paper", method="angular", **switches)


@pytest.mark.parametrize("cells", [-1, 1, 255, 4097])
def test_numbers_of_cells_out_of_range_are_refused(cells):
    with pytest.raises(OptionError, match=r"cells must be in \[256, 4096\], or 0"):
        preset("default", method="angular", cells=cells)


@pytest.mark.parametrize("resolved", [False, True])
def test_types_are_checked_whether_annotations_are_text_or_not(resolved, monkeypatch):
    """As where a program that reads command lines has looked them up before."""
    wrong: dict[str, Any] = {"errors": "median", "cells": 256.5, "off_specular": 1, "knee": "all"}
    if resolved:
        hints = typing.get_type_hints(AngularPreset)
        for each in fields(AngularPreset):
            monkeypatch.setattr(each, "type", hints[each.name])
    for name, value in wrong.items():
        with pytest.raises(OptionError, match=f"{name} must be"):
            AngularPreset(**{name: value})
