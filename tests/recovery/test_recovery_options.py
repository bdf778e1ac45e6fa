"""Recoveries run with the options of their presets."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import render_ball

import svu_mi as svu
from svu_mi.errors import OptionError, SvuError
from svu_mi.geometry.neighbors import neighbors
from svu_mi.posterior.grid import ParameterGrid
from svu_mi.posterior.spectrum import SpectrumKernel
from svu_mi.presets import PRESETS, preset
from svu_mi.recovery import recover as entry
from svu_mi.recovery import recovery_run
from svu_mi.recovery.path.pixel_loss import PathObjective
from svu_mi.recovery.recovery_options import (
    BOTH_PRESETS,
    PATH_PRESETS,
    SH_PRESETS,
    DescentOptions,
    PathOptions,
    ShOptions,
    method_options,
)
from svu_mi.recovery.recovery_run import recovery_digests
from svu_mi.recovery.regularizers.global_sharing import GlobalSharing
from svu_mi.recovery.regularizers.total_variation import TotalVariation
from svu_mi.recovery.sh.angular_l1_loss import AngularObjective
from svu_mi.recovery.sh.spectral_loss import SpectralObjective

SH = {name: asdict(options) for name, options in SH_PRESETS.items()}
PATH = {name: asdict(options) for name, options in PATH_PRESETS.items()}
BOTH = BOTH_PRESETS
ASKED = [
    *(("sh", name) for name in SH), *(("path", name) for name in PATH),
    *(("sh+path", name) for name in list(BOTH)[:2]),
]  # fmt: skip


def expected(method: str, name: str) -> dict[str, dict[str, Any]]:
    """Return the options of a preset, by part."""
    if method == "sh+path":
        first, second = BOTH[name]
        return {"sh": SH[first], "path": PATH[second]}
    return {method: {"sh": SH, "path": PATH}[method][name]}


def test_unknown_preset_is_refused_with_alternatives():
    """The message names a method with this preset: "'coefficients' is a preset of method 'sh'."."""
    tables = {"sh": SH, "path": PATH, "sh+path": BOTH}
    for method, table in tables.items():
        for name in {*SH, *PATH, "best"} - set(table):
            for given in (None, ShOptions()):
                with pytest.raises(OptionError) as refused:
                    method_options(method, name, given)
                others = [m for m, there in tables.items() if name in there]
                hint = f" {name!r} is a preset of method {others[0]!r}." if others else ""
                assert str(refused.value) == (
                    f"Unknown preset {name!r} of method {method!r}; use one of {', '.join(table)}."
                    f"{hint}"
                )


@pytest.mark.parametrize("wrong", [{"tv_space": "map"}, {"tv_epsilon": -1.0}, {"tv_edge": -0.1}])
def test_options_out_of_range_are_refused(wrong):
    for kind in (ShOptions, PathOptions):
        with pytest.raises(OptionError, match=next(iter(wrong))):
            kind(**wrong)


# ---- runs ----


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    sky = np.full((16, 32, 3), 0.3, np.float32)
    sky[3:6, 5:9] = (9, 7, 5)
    sky[8:10, 20:24] = (2, 4, 6)
    light = {"type": "envmap", "bitmap": mi.Bitmap(sky)}
    paint = {"type": "principled", "base_color": {"type": "rgb", "value": [0.6, 0.4, 0.2]},
             "roughness": 0.35, "metallic": 0.4, "specular": 0.5}  # fmt: skip
    folder = tmp_path_factory.mktemp("ball")
    return render_ball(folder, light, paint, views=8, resolution=(40, 40), spp=16)


@pytest.fixture(scope="module")
def grid(capture):
    return svu.texels(capture.mesh, (16, 12))


@pytest.fixture(scope="module")
def seen(capture, grid):
    return svu.estimate(capture, grid)


@dataclass
class RecordedCalls:
    """Recorded inputs of the parts of a recovery."""

    descents: list[DescentOptions] = field(default_factory=list)
    rules: list[list[tuple[float, Any]]] = field(default_factory=list)
    data: list[Any] = field(default_factory=list)
    variations: list[TotalVariation] = field(default_factory=list)
    sharing: list[GlobalSharing] = field(default_factory=list)


@pytest.fixture
def recorded(monkeypatch):
    """Replace every descent by one step that records its arguments."""
    recorded = RecordedCalls()
    descend, regularized = entry.descend, entry.regularized

    def brief(objective, start, options, **rest):
        recorded.descents.append(options)
        return descend(objective, start, replace(options, steps=1), **rest)

    def with_rules(data, rules, fixed=None):
        recorded.data.append(data)
        recorded.rules.append(list(rules))
        return regularized(data, rules, fixed)

    def watch(kind, made):
        ready = kind.__post_init__

        def done(self):
            ready(self)
            made.append(self)

        monkeypatch.setattr(kind, "__post_init__", done)

    for module in (entry, recovery_run):  # textures, and the smoothed start
        monkeypatch.setattr(module, "descend", brief)
    monkeypatch.setattr(entry, "regularized", with_rules)
    watch(TotalVariation, recorded.variations)
    watch(GlobalSharing, recorded.sharing)
    return recorded


def is_of_texture(variation: TotalVariation, grid: Any) -> bool:
    """Return whether neighbours are in the map; on the ball they also cross its border."""
    return variation.mesh.seams == 0 and len(variation.mesh.pairs[0]) == len(
        neighbors(grid).pairs[0]
    )


@pytest.mark.few(2)
@pytest.mark.parametrize(("method", "name"), [
    pytest.param(*asked, marks=[pytest.mark.slow] if asked[0] != "sh" else [])
    for asked in ASKED
])  # fmt: skip
def test_run_uses_the_options_of_its_preset(seen, grid, recorded, method, name):
    recovery = svu.recover(seen.observed, None, method, name)
    parts = expected(method, name)
    said = json.loads(json.dumps(recovery.settings))
    assert {part: said[part] for part in parts} == parts
    assert set(said) == {"method", "parameters", "sharing", *parts}
    assert said["sharing"] is False
    last = dict(zip(reversed(parts), reversed(recorded.descents), strict=False))
    for part, options in parts.items():
        steps = {"steps": last[part].steps} if part == "path" else {}  # as for its epochs
        assert asdict(last[part]) == options["descent"] | steps
    pairs = list(
        zip(reversed(parts), reversed(recorded.data), reversed(recorded.rules), strict=False)
    )
    for part, data, rules in pairs:
        check_data(part, data, parts[part])
        ((weight, _),) = rules
        nats = np.sqrt(grid.count) if parts[part].get("loss") == "statistics" else 1
        assert weight == pytest.approx(parts[part]["tv"] * nats)
    wanted = {(one["tv_space"], one["tv_epsilon"], one["tv_edge"]) for one in parts.values()}
    made = {("texture" if is_of_texture(v, grid) else "surface", v.epsilon, v.edge)
            for v in recorded.variations}  # fmt: skip
    assert made == wanted and len(recorded.variations) == len(parts)  # one each


def check_data(part: str, data: Any, options: dict[str, Any]) -> None:
    """The data loss is the one of the options."""
    if part == "path":
        assert isinstance(data, PathObjective)
        used = asdict(data.options) | {"max_depth": None, "descent": options["descent"]}
        assert used == options
        assert (data.halves == 1) == (not options["halves"])
    elif options["loss"] == "angular":
        assert isinstance(data, AngularObjective)
    elif options["loss"] != "statistics":
        assert isinstance(data, SpectralObjective)
        assert data.domain == options["loss"]


def test_a_start_is_that_of_the_preset(seen, recorded):
    """The paper starts at 0.5 everywhere, without a smoothed closed form."""
    svu.recover(seen, preset="paper")
    assert len(recorded.descents) == 1
    svu.recover(seen)
    assert len(recorded.descents) == 3


# ---- sharing as printed ----


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("method", "name", "source"),
    [("sh", "paper", "observed"), ("sh", "spectrum", "estimate"), ("path", "paper", "estimate"),
     ("sh+path", "paper", "observed")],
)  # fmt: skip
def test_the_paper_s_presets_share_as_printed(seen, grid, recorded, method, name, source):
    """By power spectra over 8 x 8 cells, also if the source is another estimate."""
    given = seen if source == "estimate" else seen.observed
    recovery = svu.recover(given, None, method, name, sharing=True)
    (sharing,) = recorded.sharing  # both parts of sh+path have the same one
    posterior = sharing.estimate.posterior
    assert isinstance(posterior.kernel, SpectrumKernel)
    assert posterior.grid == ParameterGrid(8, 8, "uniform")
    assert sharing.estimate.preset == PRESETS["paper"]
    assert sharing.mesh.seams > 0  # minima are those on the surface
    assert (sharing.divergence, sharing.seeding, sharing.anchored) == ("forward", "least", False)
    assert sharing.tau == 0.4
    assert 1 <= len(sharing.seeds) <= 20
    for rules in recorded.rules:
        assert [weight for weight, _ in rules] == [1e-2, 1e-2]
    assert recovery.settings["sharing"] == {
        "seeds": 20, "tau": 0.4, "seeding": "least", "divergence": "forward", "anchored": False,
        "posterior": {
            "method": "spectrum", **asdict(PRESETS["paper"]), "prior": None,
            "grid": asdict(ParameterGrid()),
        },
    }  # fmt: skip
    json.dumps(recovery.settings)


def test_sharing_reuses_existing_power_spectra(seen, recorded):
    spectra = preset("paper", method="spectrum", sigma=0.05)
    own = svu.estimate(seen.observed, method="spectrum", preset=spectra)
    recovery = svu.recover(own, preset="paper", sharing=True)
    assert recorded.sharing[0].estimate is own
    assert recovery.settings["sharing"]["posterior"]["sigma"] == 0.05
    principled = svu.estimate(seen.observed, method="spectrum")
    svu.recover(principled, preset="paper", sharing=True)
    assert recorded.sharing[1].estimate.preset == PRESETS["paper"]


def test_known_roughness_reaches_the_papers_posterior(seen, recorded):
    own = svu.estimate(seen, known={"roughness": 0.4})
    recovery = svu.recover(own, preset="paper", sharing=True)
    assert list(recorded.sharing[0].estimate.posterior.axes["roughness"]) == [0.4]
    assert recovery.settings["sharing"]["posterior"]["grid"]["known"] == {"roughness": 0.4}
    doubted = svu.estimate(seen, prior=np.arange(8.0))
    svu.recover(doubted, preset="paper", sharing=True)
    prior = recorded.sharing[1].estimate.posterior.prior
    np.testing.assert_allclose(prior.sum(axis=1), np.arange(8) / 28, atol=1e-9)
    few = svu.estimate(seen, grid=svu.PrincipledGrid(roughness=4), prior=np.ones(4))
    with pytest.raises(SvuError, match="has 4 roughness nodes"):
        svu.recover(few, preset="paper", sharing=True)


def test_losses_of_the_paper_can_use_a_common_prior(seen, recorded):
    """It is a separate loss term; a weight of 0 disables it."""
    mixed = replace(SH_PRESETS["paper"], common_prior=True, sharing=8.0)
    recovery = svu.recover(seen, sharing=True, sh=mixed)
    assert recovery.settings["sharing"] is True and len(recorded.rules[-1]) == 2
    none = svu.recover(seen, sharing=True, sh=replace(mixed, sharing=0.0))
    assert none.settings["sharing"] is False


def test_custom_sharing_is_recorded(seen, recorded):
    rule = GlobalSharing(seen, seeds=[3, 8], tau=0.3)
    recovery = svu.recover(seen, sharing=rule)
    assert recovery.settings["sharing"] == {
        "seeds": 2, "tau": 0.3, "seeding": "spread", "divergence": "reverse", "anchored": True,
    }  # fmt: skip
    assert recorded.sharing == [rule]


# ---- checkpoints ----


def test_anchored_is_part_of_the_fingerprint(seen, capture, grid):
    rules = (GlobalSharing(seen, seeds=[3, 8], anchored=anchored) for anchored in (True, False))
    marks = [
        recovery_digests(capture, grid, None, rule, None)["seeds of sharing"] for rule in rules
    ]
    assert marks[0] != marks[1]
