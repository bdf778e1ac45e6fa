"""Filling of unseen texels by symmetry: on known surfaces, and by ``svu``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from recovery.test_texture_field import square, those_first
from support.helpers import fails, names, run

from svu_mi.core.arrays import to_drjit
from svu_mi.core.io.exr import read_exr
from svu_mi.errors import CaptureError, OptionError, ShapeError
from svu_mi.geometry.neighbors import connected_components, neighbors
from svu_mi.output.texture_files import read_textures, recovery_settings
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.inpaint import combine_predictors, texel_hierarchy
from svu_mi.recovery.inpaint.combine_predictors import MEAN_WEIGHTS, TITLES, tv_predictions
from svu_mi.recovery.inpaint.cross_validation import (
    TOLERANCE,
    HoldoutErrors,
    PredictorErrors,
    holdout_masks,
)
from svu_mi.recovery.inpaint.fill import fill
from svu_mi.recovery.inpaint.fill_result import Filled
from svu_mi.recovery.inpaint.symmetry_predictors import (
    FEWEST,
    KNN_SETTINGS,
    KnownTexels,
    SymmetryPredictor,
)
from svu_mi.recovery.inpaint.texel_hierarchy import Pieces, TexelGraph, normalized_points
from svu_mi.recovery.recover import recover
from svu_mi.recovery.recovery_options import ShOptions
from svu_mi.recovery.svbrdf_textures import lay_out
from svu_mi.recovery.uncertainty.gmrf import Smoother
from svu_mi.recovery.uncertainty.texture_field import TextureField, field_around, tv_weights

Y = (0.0, 1.0, 0.0)


def cylinder(columns: int) -> Pieces:
    """Texels on the side of a cylinder around y: one piece."""
    angle = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    around, up = np.meshgrid(angle, np.linspace(-1, 1, 60))
    normal = np.stack([np.cos(around), 0 * up, np.sin(around)], axis=-1).reshape(-1, 3)
    points = normal + [0, 1, 0] * up.reshape(-1, 1)
    return Pieces(normalized_points(points), normal, np.zeros(len(points), np.int64))


def known_of(values: np.ndarray, texels: np.ndarray) -> KnownTexels:
    return KnownTexels(texels, values[:, texels], np.ones((len(values), len(texels))))


@pytest.mark.parametrize("likeness", [
    SymmetryPredictor("near"), SymmetryPredictor("level", Y), SymmetryPredictor("turned", Y),
    SymmetryPredictor("turned piece", Y),
    SymmetryPredictor("mirrored", (1.0, 0.0, 0.0)), SymmetryPredictor("repeated", Y, (4,)),
])  # fmt: skip
def test_predictors_use_similar_texels(likeness: SymmetryPredictor) -> None:
    """Bands around a cylinder: rotation or reflection predicts the far side, neighbours do not."""
    pieces = cylinder(240)
    x, y, _ = pieces.point.T
    values = np.sin(9 * y)[None] * 0.5 + 0.5
    wanted = np.flatnonzero(x < -0.1)
    known = known_of(values, np.flatnonzero(x > 0))
    ((predicted, alike),) = likeness.predict(pieces, known, wanted)
    assert predicted.shape == (1, len(wanted)) and alike.all()
    error = np.abs(predicted - values[:, wanted])
    assert error.mean() < (0.03 if likeness.kind != "near" else 0.2)


def test_a_pattern_around_an_axis_is_continued() -> None:
    """Three of six petals are known: repetition finds the others, height and radius do not."""
    pieces = cylinder(360)
    x, _, z = pieces.point.T
    values = (np.sin(6 * np.arctan2(z, x)) > 0)[None].astype(float)
    known, wanted = known_of(values, np.flatnonzero(x > 0.02)), np.flatnonzero(x < -0.02)
    off = {}
    for likeness in (SymmetryPredictor("turned", Y), SymmetryPredictor("repeated", Y, (6, 4))):
        found = likeness.predict(pieces, known, wanted)
        for title, (predicted, alike) in zip(likeness.titles, found, strict=True):
            off[title] = np.abs(predicted - values[:, wanted])[:, alike].mean()
    assert off["repeated 6 times about y"] < 0.03
    assert min(off["turned about y"], off["repeated 4 times about y"]) > 0.3


def test_pieces_are_of_one_material() -> None:
    """Two adjacent balls with known halves: the nearest texels belong to the other ball."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points = np.concatenate([ring - [1.05, 0, 0], ring + [1.05, 0, 0]])
    piece = np.repeat([0, 1], 60)
    pieces = Pieces(normalized_points(points), np.concatenate([ring, ring]), piece)
    values = np.array([0.2, 0.9])[piece][None]
    hidden = np.concatenate([np.cos(angle) > 0.2, np.cos(angle) < -0.8])
    known, wanted = known_of(values, np.flatnonzero(~hidden)), np.flatnonzero(hidden)
    for likeness in (
        SymmetryPredictor("piece"),
        SymmetryPredictor("near"),
        SymmetryPredictor("turned piece", Y),
    ):
        ((predicted, alike),) = likeness.predict(pieces, known, wanted)
        assert alike.all(), likeness
        np.testing.assert_allclose(predicted, values[:, wanted], atol=1e-9, err_msg=likeness.kind)
    middle = normalized_points(points)[piece == 1].mean(axis=0)
    np.testing.assert_allclose(pieces.middle[60:], np.tile(middle, (60, 1)), atol=1e-12)


def test_pieces_with_few_known_texels_do_not_predict() -> None:
    pieces = replace(cylinder(20), piece=np.repeat([0, 1], 600))
    values = np.full((1, 1200), 0.4)
    some = known_of(values, np.concatenate([np.arange(100), 600 + np.arange(FEWEST - 1)]))
    for kind in ("piece", "near", "turned piece"):
        ((_, alike),) = SymmetryPredictor(kind).predict(pieces, some, np.array([200, 700]))
        assert alike.tolist() == [True, False], kind


def sheet(
    side: int, hole: np.ndarray, alone: np.ndarray, fields: int = 1
) -> tuple[TexelGraph, np.ndarray]:
    """A square of certain texels with a slope and a hole, a separate piece in the hole, and
    true values."""
    rows, columns = np.divmod(np.arange(side**2), side)
    true = np.repeat((0.6 + 0.6 * (columns / (side - 1) - 0.5))[None], fields, axis=0)
    around = square(side)
    around = those_first(np.where(alone[around] == alone, around, np.arange(side**2)))
    values, deviation = np.where(hole, 0.5, true), np.where(hole, 0.3, 0.01 + 0 * true)
    lanes = [to_drjit(mi.UInt32, column.astype(np.uint32)) for column in around]
    smoother = Smoother.of(1 / deviation**2, values, lanes, 3.0, 0.01)
    pieces = Pieces(
        np.zeros((side**2, 3)), np.zeros((side**2, 3)), connected_components(list(around))
    )
    squares = np.stack([rows, columns], axis=1)
    weights, ones = 1 / deviation**2, np.ones(side**2)
    return TexelGraph(values, weights, values, ~hole, ones, squares, pieces, smoother), true


def round_hole(side: int, radius: float) -> np.ndarray:
    across, down = np.meshgrid(*[np.linspace(-1, 1, side)] * 2)
    return (np.hypot(across, down) < radius).ravel()


@pytest.mark.parametrize("enough", [2**16, 1000])
@pytest.mark.parametrize("title", MEAN_WEIGHTS)
def test_values_spread_to_the_middle_of_a_large_hole(monkeypatch, title: str, enough: int) -> None:
    """A slope of certain texels continues into the hole; the separate piece has no known texel."""
    monkeypatch.setattr(texel_hierarchy, "MOST_TEXELS", enough)
    hole, alone = round_hole(120, 0.7), round_hole(120, 0.1)
    graph, true = sheet(120, hole, alone)
    assert graph.is_large == (enough == 1000)
    ((_, predicted),) = tv_predictions(graph, {title})
    np.testing.assert_array_equal(predicted[:, ~hole], graph.values[:, ~hole])
    np.testing.assert_allclose(predicted[:, alone], true[:, ~hole].mean(), atol=1e-5)
    off = (predicted - true)[:, hole & ~alone]
    assert np.abs(off).max() < 0.04 and np.sqrt((off**2).mean()) < 0.01


@pytest.mark.parametrize("title", MEAN_WEIGHTS)
def test_pieces_without_known_texels_get_the_mean(title: str) -> None:
    hole = round_hole(40, 0.5)
    graph, true = sheet(40, hole, hole, fields=5)
    ((_, predicted),) = tv_predictions(graph, {title})
    np.testing.assert_allclose(predicted[:, hole], true[:, ~hole].mean(), atol=1e-5)
    np.testing.assert_array_equal(predicted[:, ~hole], graph.values[:, ~hole])
    ((_, bright),) = tv_predictions(replace(graph, values=2 * graph.values), {title})
    assert bright.max() == 1  # also where texels are known, as reflectance is


@pytest.mark.parametrize("title", MEAN_WEIGHTS)
def test_known_values_far_from_holes_have_no_influence(monkeypatch, title: str) -> None:
    hole = round_hole(240, 0.15)
    graph, _ = sheet(240, hole, np.zeros_like(hole))
    ((_, near),) = tv_predictions(graph, {title})
    monkeypatch.setattr(combine_predictors, "SMOOTHED_BORDER", 240)
    ((_, whole),) = tv_predictions(graph, {title})
    np.testing.assert_allclose(near[:, hole], whole[:, hole], atol=1e-3)


def test_groups_are_all_known_or_all_unknown() -> None:
    hole, alone = round_hole(41, 0.7), round_hole(41, 0.3)
    graph, _ = sheet(41, hole, alone)
    groups, owner = graph.halved
    count = len(groups.known)
    assert len(owner) == len(graph.known) and owner.max() + 1 == count < 0.4 * len(owner)
    np.testing.assert_array_equal(groups.known[owner], graph.known)
    np.testing.assert_array_equal(groups.square[owner], graph.square // 2)
    np.testing.assert_array_equal(groups.size, np.bincount(owner))
    same = groups.pieces.piece[owner]
    assert len(set(zip(same, graph.pieces.piece, strict=True))) == len(set(same))
    for group in np.random.default_rng(0).integers(count, size=50):
        texels = owner == group
        assert 1 <= texels.sum() <= 4
        w, v = graph.weights[0, texels], graph.values[0, texels]
        assert groups.weights[0, group] == pytest.approx(w.sum())
        assert groups.values[0, group] == pytest.approx((w * v).sum() / w.sum())
        assert groups.single[0, group] in v
    # Links of groups follow from links of texels.
    linked, wanted = set(), set()
    for column in groups.smoother.around:
        linked |= set(enumerate(np.array(column).tolist()))
    for column in graph.smoother.around:
        wanted |= set(zip(owner.tolist(), owner[np.array(column)].tolist(), strict=True))
    own = {(group, group) for group in range(count)}
    assert linked - own == wanted - own


@pytest.mark.parametrize("title", MEAN_WEIGHTS)
def test_values_spread_equally_over_groups_and_texels(monkeypatch, title: str) -> None:
    """Cross-validation on groups must measure the predictions that fill texels."""
    hole = round_hole(128, 0.8)
    graph, _ = sheet(128, hole, np.zeros_like(hole))
    ((_, fine),) = tv_predictions(graph, {title})
    groups, first = graph.halved
    groups, second = groups.halved
    assert len(groups.known) < len(graph.known) / 12
    ((_, coarse),) = tv_predictions(groups, {title})
    # A group spans a slope of 0.02, with a standard deviation of 0.006.
    assert np.sqrt(((coarse[:, second[first]] - fine)[:, hole] ** 2).mean()) < 0.008


def test_scattered_known_texels_form_no_groups(monkeypatch) -> None:
    monkeypatch.setattr(texel_hierarchy, "MOST_TEXELS", 100)
    hole = np.indices((40, 40)).sum(axis=0).ravel() % 2 > 0
    graph, true = sheet(40, hole, np.zeros_like(hole))
    assert not graph.is_large and graph.coarsest is graph
    for _, predicted in tv_predictions(graph):
        assert np.abs(predicted - true).max() < 0.02


def judged_of(errors: np.ndarray) -> PredictorErrors:
    """Return predictor errors of one value, from errors (P, G, w) of two parts."""
    trials = [HoldoutErrors(e[:, None], np.full(e.shape[1], 1 / e.shape[1])) for e in errors]
    return PredictorErrors(np.stack([trial.products(slice(0, 1)) for trial in trials]))


def test_filling_is_never_worse_than_tv_on_held_out_parts() -> None:
    random = np.random.default_rng(0)
    for _ in range(20):
        size = (2, len(TITLES), 50)
        errors = random.normal(0, random.uniform(0.05, 0.5, (*size[:2], 1)), size)
        judged = judged_of(errors)
        weights = judged.weights()
        assert sum(weights.values()) == pytest.approx(1) and min(weights.values()) >= 0
        alone = judged.squares(dict(zip(TITLES, judged.tv_weights.tolist(), strict=True)))
        assert (judged.squares(weights) <= alone + 2 * TOLERANCE**2).all()
        none = judged.weights(max_share=0.0)
        assert set(title for title, weight in none.items() if weight > 0) <= set(MEAN_WEIGHTS)


def test_predictors_of_invisible_weight_are_not_evaluated() -> None:
    errors = np.full((2, len(TITLES), 40), 0.4)
    errors[:, : len(MEAN_WEIGHTS)] = 0.1  # by total variation
    judged = judged_of(errors)
    assert 0 < judged.share < TOLERANCE
    assert {title for title, weight in judged.weights().items() if weight} == set(MEAN_WEIGHTS)


def test_better_predictors_get_larger_weights() -> None:
    errors = np.full((2, len(TITLES), 40), 0.4)
    errors[:, TITLES.index("turned about y")] = 0.1
    errors[0, TITLES.index("near")] = 0.1  # on one part only
    weights = judged_of(errors).weights()
    order = sorted(weights, key=lambda title: -weights[title])
    assert order[:2] == ["turned about y", "near"]
    # If total variation alone is right on one part, it keeps its weight.
    errors[1, : len(MEAN_WEIGHTS)] = 0.0
    assert judged_of(errors).share < 0.01
    errors[1] = 0.0  # all are
    assert judged_of(errors).share == 1.0


def test_predictor_without_neighbours_has_no_match() -> None:
    far = 3 * KNN_SETTINGS["mirrored"].farthest
    points = np.array([[0.5, 0, 0], [0.51, 0, 0], [-0.5, far, 0]], float)
    pieces = Pieces(points, np.zeros((3, 3)), np.zeros(3, np.int64))
    known = known_of(np.ones((1, 3)), np.array([0, 1]))
    mirrored = SymmetryPredictor("mirrored", (1.0, 0.0, 0.0))
    ((predicted, alike),) = mirrored.predict(pieces, known, np.array([2]))
    assert not alike.any() and np.isfinite(predicted).all()


@pytest.fixture(scope="module")
def banded(vase: SimpleNamespace) -> SimpleNamespace:
    """The vase painted in bands around its axis, known everywhere but on one side."""
    texels = vase.texels
    position = np.array(texels.position, np.float64).T
    height = normalized_points(position)[:, 1]
    bands = 0.5 + 0.4 * np.sign(np.sin(40 * height))
    values = {
        name: np.tile((bands if name != "metallic" else 0 * bands + 0.1)[:, None], CHANNELS[name])
        for name in NAMES
    }
    textures = lay_out(texels, values)
    around = neighbors(texels, vase.capture.mesh)
    field = field_around(textures, vase.estimate, around)
    hidden = normalized_points(position)[:, 0] < -0.08
    return SimpleNamespace(field=field, hidden=hidden, values=values)


@pytest.fixture(scope="module")
def filled(banded: SimpleNamespace) -> Filled:
    return fill(banded.field, ~banded.hidden)


def error(field: TextureField, banded: SimpleNamespace, name: str) -> float:
    true = np.squeeze(banded.values[name])[banded.hidden]
    estimated = field.textures.at(field.texels, name)[banded.hidden]
    return float(np.sqrt(((estimated - true) ** 2).mean()))


def test_bands_are_filled_from_the_other_side(banded: SimpleNamespace, filled: Filled) -> None:
    """The given field has the true values of hidden texels, which must not be used."""
    field, hidden = banded.field, banded.hidden
    other = lay_out(field.texels, {
        name: np.where(hidden[:, None], 0.77, x) for name, x in banded.values.items()
    })  # fmt: skip
    spoiled = replace(field, textures=other)
    result = fill(spoiled, ~hidden)
    for name in NAMES:
        got, wanted = (each.textures.at(field.texels, name) for each in (result, filled))
        np.testing.assert_allclose(got, wanted, atol=2e-3)
    weights = result.weights["roughness"]
    assert sum(weights.values()) == pytest.approx(1)
    assert max(weights, key=weights.get).endswith(("about y", "along y"))
    assert result.likeness["roughness"].count("%") == 3
    assert error(result.field, banded, "roughness") < 0.15  # they differ by .8
    for name in NAMES:  # seen texels do not change
        new, old = (each.textures.at(field.texels, name)[~hidden] for each in (result, field))
        np.testing.assert_allclose(new, old, atol=1e-6)
    assert (result.field.width[:, hidden] >= spoiled.width[:, hidden] - 1e-6).all()
    np.testing.assert_array_equal(result.filled, hidden)
    (draw,) = result.field.draw(1)
    assert np.isfinite(np.array(draw.roughness)).all()


@pytest.mark.slow
def test_common_scale_is_counted_once(banded: SimpleNamespace) -> None:
    """With estimated light: texels that are not filled keep their sd, also if filled again."""
    field = replace(banded.field, scale=np.array([0.1, 0.2, 0.3]))
    result = fill(field, ~banded.hidden)
    np.testing.assert_allclose(result.field.width[:, ~banded.hidden],
                               field.width[:, ~banded.hidden], rtol=1e-4)  # fmt: skip
    assert (result.field.width >= field.width - 1e-6).all()
    drawn = np.array([np.array(draw.base_color)[..., 2] for draw in result.field.draw(48)])
    wide = field.texels.to_image(result.field.sd("base_color")[:, 2])
    seen = field.texels.to_image(~banded.hidden, False)
    assert np.median(drawn.std(axis=0)[seen] / wide[seen]) == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_large_textures_are_cross_validated_by_groups(monkeypatch, banded) -> None:
    """Wide stripes: predictions and their errors are nearly equal."""
    field, hidden = banded.field, banded.hidden
    _, y, z = normalized_points(np.array(field.texels.position).T).T
    stripes = (0.5 + 0.4 * np.sin(4 * y + 3 * np.abs(z)))[:, None]
    smooth = {name: np.repeat(stripes, count, axis=1) for name, count in CHANNELS.items()}
    field = replace(field, textures=lay_out(field.texels, smooth))
    whole = fill(field, ~hidden)
    monkeypatch.setattr(texel_hierarchy, "MOST_TEXELS", field.texels.count // 2)
    filled = fill(field, ~hidden)
    for name in NAMES:
        # The coarser texels give other held-out parts.
        assert 0.5 < filled.errors[name] / whole.errors[name] < 2
        new, old = (each.field.values[field.rows(name)] for each in (filled, whole))
        off, before = (np.abs(x - smooth[name].T)[:, hidden].mean() for x in (new, old))
        assert off < 1.2 * before
        np.testing.assert_array_equal(new[:, ~hidden], old[:, ~hidden])


def test_intervals_of_filled_texels_have_coverage(banded: SimpleNamespace, filled: Filled) -> None:
    low, high = filled.field.interval("roughness")
    true = np.squeeze(banded.values["roughness"])
    assert ((low <= true) & (true <= high))[banded.hidden].mean() > 0.8


def test_all_seen_and_none_seen(banded: SimpleNamespace) -> None:
    field = banded.field
    whole = fill(field, np.ones(field.texels.count, bool))
    assert whole.field is field and not whole.filled.any()
    with pytest.raises(CaptureError, match=r"^0 of \d+ texels are seen, too few"):
        fill(field, np.zeros(field.texels.count, bool))


@pytest.mark.slow
def test_single_unseen_texel_is_filled(banded: SimpleNamespace) -> None:
    seen = np.ones(banded.field.texels.count, bool)
    seen[7] = False
    result = fill(banded.field, seen)
    np.testing.assert_array_equal(np.flatnonzero(result.filled), [7])
    assert np.isfinite(result.field.values).all() and np.isfinite(result.field.width).all()


@pytest.mark.slow
def test_filled_sd_is_at_least_the_held_out_error(banded, filled: Filled) -> None:
    """Also of clipped values, where clipping halves a normal distribution."""
    for name in NAMES:
        assert (filled.field.sd(name)[banded.hidden] > 0.97 * filled.errors[name]).all()


def test_impossible_fills_are_refused(banded: SimpleNamespace) -> None:
    field, seen = banded.field, ~banded.hidden
    for flags in (seen[:-1], seen[:, None], np.True_):
        with pytest.raises(ShapeError, match=f"one flag for each of {len(seen)} texels"):
            fill(field, flags)
    for above in (0.0, -1.0, np.nan):
        with pytest.raises(OptionError, match="above must be positive"):
            fill(field, seen, above)
    with pytest.raises(CaptureError, match="too few texels are certain enough"):
        fill(field, seen, above=1e-6)


def test_flat_objects_hold_out_sides() -> None:
    """All texels have one normal, so clusters of normals would contain all of them."""
    x, y = (side.ravel() for side in np.meshgrid(np.arange(20.0), np.arange(12.0)))
    point = normalized_points(np.stack([x, y, 0 * x], axis=1))
    pieces = Pieces(point, np.tile([0.0, 0, 1], (len(point), 1)), np.zeros(len(point), np.int64))
    seen = x < 13
    none = np.zeros((1, len(point)))
    parts = holdout_masks(TexelGraph(none, none, none, seen, none[0], point[:, :2], pieces, None))
    assert len(parts) >= 2
    for part in parts:
        assert part.any() and not part[~seen].any() and (seen & ~part).any()


def test_how_textures_were_recovered(tmp_path: Path) -> None:
    assert recovery_settings(tmp_path) == {} and tv_weights({}) == ShOptions()
    used = {"parameters": ["roughness"], "sh": {"loss": "statistics", "tv": 2, "tv_epsilon": 0.5}}
    (tmp_path / "run.json").write_text(json.dumps({"settings": {"used": used}}))
    assert recovery_settings(tmp_path) == used
    assert tv_weights(used) == ShOptions(tv=2, tv_epsilon=0.5)
    (tmp_path / "run.json").write_text("{")
    assert recovery_settings(tmp_path) == {}


@pytest.mark.slow
def test_uncertain_texels_are_fused_by_precision(vase: SimpleNamespace) -> None:
    recovery = recover(vase.estimate)
    field = field_around(
        recovery.textures, recovery.estimate, neighbors(vase.texels, vase.capture.mesh)
    )
    seen = recovery.coverage > 0
    limit = float(np.quantile(field.sds[:, seen].max(axis=0), 0.8))
    result = fill(field, seen, above=limit)
    filled = result.filled & seen
    assert 0.1 < filled.sum() / seen.sum() < 0.3
    np.testing.assert_array_equal(result.filled, ~seen | (field.sds > limit).any(axis=0))
    sure = fill(field, seen)
    np.testing.assert_array_equal(sure.filled, ~seen)
    assert (result.field.width >= field.width - 1e-6).all()


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_the_command_fills_and_others_take_the_result(shot, tmp_path, capsys):
    textures, out = tmp_path / "textures", tmp_path / "filled"
    assert run("recover", shot, "--resolution", 32, "--steps", 20, "-o", textures) == 0
    assert run("inpaint", shot, "--recovered", textures, "-o", out) == 0
    assert "filled" in capsys.readouterr().out
    files = names(out)
    assert {"base_color.exr", "filled.exr", "filled.png", "recovered.xml", "run.json",
            "uncertainty.exr"} <= set(files)  # fmt: skip
    mask, coverage = read_exr(out / "filled.exr")["Y"], read_exr(textures / "coverage.exr")["Y"]
    assert mask.max() == 1 and mask[coverage > 0].max() == 0
    before, after = (read_textures(folder) for folder in (textures, out))
    change = np.abs(np.array(after.roughness) - np.array(before.roughness))[..., 0]
    assert change[coverage > 0].max() < 1e-6
    record = json.loads((out / "run.json").read_text())
    assert record["result"]["filled"] > 0 and set(record["result"]["likeness"]) == set(NAMES)
    assert run("export", out, "-o", tmp_path / "asset") == 0
    assert "--above must be positive" in fails(
        capsys, "inpaint", shot, "--recovered", textures, "--above", -1, "-o", out
    )
    assert "no such folder; give one that svu recover wrote" in fails(
        capsys, "inpaint", shot, "--recovered", tmp_path / "none", "-o", tmp_path / "other"
    )
