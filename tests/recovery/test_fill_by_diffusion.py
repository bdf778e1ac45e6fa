"""Filling by diffusion without weights: blending, views, values of texels, errors."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import fails, names, write_older

from svu_mi.capture.sensors import film_size, windowed_sensor
from svu_mi.capture.tonemap import ObjectView, object_only_scene
from svu_mi.errors import CaptureError, OptionError, SvuEnvironmentError, SvuError
from svu_mi.geometry.neighbors import neighbors
from svu_mi.output.write_fill import fill_sentences, write_filled
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.inpaint.diffusion import load_weights
from svu_mi.recovery.inpaint.diffusion.fill_by_diffusion import fill_by_diffusion
from svu_mi.recovery.inpaint.diffusion.latent_diffusion import blend
from svu_mi.recovery.inpaint.diffusion.load_weights import FOLDERS, require_model
from svu_mi.recovery.inpaint.diffusion.model_interface import (
    FAMILIES,
    DiffusionOptions,
    ModelInput,
    family_of,
)
from svu_mi.recovery.inpaint.fill_result import LEAST_SD, Filled
from svu_mi.recovery.inpaint.texel_hierarchy import normalized_points
from svu_mi.recovery.relighting import relight
from svu_mi.recovery.svbrdf_textures import lay_out, scene_textures
from svu_mi.recovery.uncertainty.texture_field import field_around

SHAPE = (3, 5, 7)


class Ddim:
    """Deterministic steps between times 1 ... 0 of noise; a model predicts the noise.

    Attributes:
        blended: times of all calls of ``noised``.
    """

    def __init__(self, steps: int) -> None:
        self.times = list(np.linspace(1, 0, steps, endpoint=False))
        self.blended: list[float] = []

    @staticmethod
    def parts(time: float) -> tuple[float, float]:
        return np.cos(np.pi / 2 * time), np.sin(np.pi / 2 * time)

    def _next(self, time: float) -> float:
        place = self.times.index(time) + 1
        return self.times[place] if place < len(self.times) else 0.0

    def step(self, latent: Any, predicted: Any, time: float) -> Any:
        (a, s), (b, r) = self.parts(time), self.parts(self._next(time))
        if a < 1e-6:  # the initial value has no effect: the model alone determines the result
            return b * predicted + r * latent
        return b * (latent - s * predicted) / a + r * predicted

    def noised(self, clean: Any, noise: Any, time: float) -> Any:
        self.blended.append(time)
        a, s = self.parts(time)
        return a * clean + s * noise


def blended(free: int, predict: Callable[[Any, float], Any], steps: int = 50) -> SimpleNamespace:
    """Run the loop and record the inputs of the model."""
    random = np.random.default_rng(743051821)
    known, noise = random.standard_normal((2, *SHAPE))
    certain = (np.indices(SHAPE[1:]).sum(axis=0) % 3 == 0).astype(float)
    given: list[np.ndarray] = []

    def model(latent: np.ndarray, time: float) -> np.ndarray:
        given.append(latent.copy())
        return predict(latent, time)

    schedule = Ddim(steps)
    result = blend(model, schedule, known, certain, noise, free)
    return SimpleNamespace(latent=result, known=known, noise=noise, given=given, schedule=schedule,
                           certain=np.broadcast_to(certain > 0, SHAPE))  # fmt: skip


@pytest.mark.parametrize("free", [0, 10, 20, 50])
def test_certain_latents_are_restored_until_the_last_steps(free: int) -> None:
    """Inputs of the model equal n(x, t) where M is 1, except in the last steps."""
    run = blended(free, lambda latent, time: np.tanh(3 * latent + time))
    assert len(run.given) == 50
    times, inside = run.schedule.times, run.certain
    back = 50 - free
    assert run.schedule.blended == times[1 : back + 1]  # after the last step, x is restored
    for number in range(1, 50):
        a, s = Ddim.parts(times[number])
        right = np.abs(run.given[number] - (a * run.known + s * run.noise))[inside].max() < 1e-12
        assert right == (number <= back), number
    kept = np.abs(run.latent - run.known)[inside].max()
    assert kept == 0 if free == 0 else kept > 0.01


def test_uncertain_latents_follow_the_model() -> None:
    """This model treats pixels independently, so certain ones must not affect uncertain ones."""

    def model(latent: np.ndarray, time: float) -> np.ndarray:
        return np.tanh(3 * latent + time)

    run = blended(10, model)
    latent = run.noise
    for time in run.schedule.times:
        latent = run.schedule.step(latent, model(latent, time), time)
    outside = ~run.certain
    np.testing.assert_allclose(run.latent[outside], latent[outside], atol=1e-12)


class Truth:
    """Substitute for a model that returns true maps of a scene, or a constant."""

    title, licence, runs = "the truth", "none", 2

    def __init__(self, object_: SimpleNamespace, always: float | None = None) -> None:
        self.object, self.always = object_, always
        self.asked: list[tuple[ModelInput, int]] = []
        self.steps: list[tuple[int, int]] = []

    def predict(
        self, picture: ModelInput, steps: int, free: int, seed: int, after_step: Callable[[], None]
    ) -> dict[str, np.ndarray]:
        self.asked.append((picture, seed))
        self.steps.append((steps, free))
        look, maps = ObjectView.of(object_only_scene(self.object.capture), picture.sensor), {}
        for name in NAMES:
            image = np.array(self.object.truth[name])
            shown = look.values(np.broadcast_to(image, (*image.shape[:2], 3)))
            shown = shown if CHANNELS[name] > 1 else shown[..., 0]
            maps[name] = shown if self.always is None else np.full_like(shown, self.always)
        for _ in range(steps * self.runs):
            after_step()
        return maps


@pytest.fixture(scope="module")
def painted(vase: SimpleNamespace) -> SimpleNamespace:
    """The vase with true textures as recovered ones, and one unseen side."""
    truth = scene_textures(vase.capture, vase.texels)
    field = field_around(truth, vase.estimate, neighbors(vase.texels, vase.capture.mesh))
    side = normalized_points(np.array(vase.texels.position, np.float64).T)[:, 0]
    shown = np.array(vase.estimate.coverage > 0) & (side > -0.1)
    values = {name: np.where(shown, field.values[field.rows(name)], 0.5).T for name in NAMES}
    field = replace(field, textures=lay_out(vase.texels, values))
    return SimpleNamespace(capture=vase.capture, truth=truth, field=field, shown=shown)


OPTIONS = DiffusionOptions(views=3, steps=4, free=1, side=96, seed=5)


@pytest.fixture(scope="module")
def by_truth(painted: SimpleNamespace) -> tuple[Filled, Truth]:
    model = Truth(painted)
    filled = fill_by_diffusion(
        painted.capture, painted.field, painted.shown, model, options=OPTIONS
    )
    return filled, model


@pytest.mark.slow
def test_texels_take_the_models_values(painted, by_truth) -> None:
    """A model with true maps gives true texels: maps are not flipped or shifted."""
    result, _ = by_truth
    model = result.invented
    assert model is not None and [answer.source for answer in model.answers] == ["renders"]
    assert model.reached.sum() > 0.3 * result.filled.sum()
    assert not model.reached[painted.shown].any()
    for name in NAMES:
        true, got = (each.at(painted.field.texels, name)
                     for each in (painted.truth, result.textures))  # fmt: skip
        off = np.abs(got - true)[model.reached]
        spread = true[model.reached].std()
        # Remaining errors are at edges of the pattern, where a pixel shows several texels.
        assert np.median(off) < 0.01 and off.mean() < 0.25 * spread, name
        np.testing.assert_allclose(got[painted.shown], true[painted.shown], atol=1e-6)
        answer = model.answers[0]
        assert answer.errors[name] < 0.6 * max(answer.likeness[name], 0.1), name


@pytest.mark.slow
def test_filling_never_reduces_the_sd(painted, by_truth) -> None:
    result, _ = by_truth
    assert (result.field.width >= painted.field.width - 1e-6).all()
    np.testing.assert_array_equal(result.filled, ~painted.shown)


@pytest.mark.slow
def test_model_input_contains_known_values(painted, by_truth) -> None:
    filled, model = by_truth
    assert set(model.steps) == {(4, 1)}
    seeds = [seed for _, seed in model.asked]
    assert len(set(seeds)) == len(seeds) > 3
    for picture, _ in model.asked:
        assert picture.photograph.shape == (*picture.certain.shape, 3)
        assert picture.photograph.min() >= 0 and picture.photograph.max() == 1
        assert max(picture.certain.shape) == OPTIONS.side
    # The first picture of a task; later inputs contain earlier outputs of the model.
    for place in (0, -len(filled.invented.answers[0].pictures)):
        picture = model.asked[place][0]
        look = ObjectView.of(object_only_scene(painted.capture), picture.sensor)
        image = np.array(painted.truth.roughness)
        true = look.values(np.broadcast_to(image, (*image.shape[:2], 3)))[..., 0]
        off = np.abs(true - picture.maps["roughness"])
        assert picture.certain.any() and off[picture.certain].max() < 1e-5
        assert off[~picture.certain].max() > 0.1


@pytest.mark.slow
def test_held_out_texels_are_unknown_to_the_model(by_truth) -> None:
    """Values without a prediction are the recovery's, which are true here."""
    filled, _ = by_truth
    assert min(filled.invented.answers[0].likeness.values()) > 0.01


@pytest.fixture(scope="module")
def by_quarter(painted: SimpleNamespace) -> tuple[Filled, Truth]:
    """By a model with output 0.25, also for uncertain texels."""
    limit = float(np.quantile(painted.field.sds[:, painted.shown].max(axis=0), 0.7))
    model = Truth(painted, always=0.25)
    filled = fill_by_diffusion(painted.capture, painted.field, painted.shown, model, limit, OPTIONS)
    return filled, model


@pytest.mark.slow
def test_model_values_are_fused_by_precision(painted, by_quarter) -> None:
    filled, _ = by_quarter
    field, shown = painted.field, painted.shown
    answers = {answer.source: answer for answer in filled.invented.answers}
    reached, unseen = (answers[source].reached for source in ("photographs", "renders"))
    assert reached.any() and not reached[~shown].any() and not unseen[shown].any()
    for name in NAMES:
        rows = field.rows(name)
        off = max(answers["photographs"].errors[name], LEAST_SD)
        own = 1 / np.maximum(field.sds[rows][:, reached], LEAST_SD) ** 2
        wanted = (own * field.values[rows][:, reached] + 0.25 / off**2) / (own + 1 / off**2)
        np.testing.assert_allclose(filled.field.values[rows][:, reached], wanted, atol=1e-4)
        np.testing.assert_allclose(filled.field.values[rows][:, unseen], 0.25, atol=1e-4)
    assert (filled.field.width >= field.width - 1e-6).all()


@pytest.mark.slow
def test_summary_names_the_model_and_its_error(by_quarter) -> None:
    filled, _ = by_quarter
    said = " ".join(fill_sentences(filled))
    assert "by the truth; licence of its weights: none." in said
    assert "photograph" in said and "From 3 renders." in said and "similar texels" in said


@pytest.mark.slow
def test_photographs_are_cut_to_the_object(painted, by_quarter) -> None:
    """The crop of a photograph matches the sensor of the model input."""
    filled, model = by_quarter
    answer = filled.invented.answers[0]
    assert answer.source == "photographs"
    for picture, _ in model.asked[: len(answer.pictures)]:
        assert max(picture.certain.shape) <= 48
        (render,) = relight(painted.capture, None, None, [picture.sensor], 64, seed=3)
        look = ObjectView.of(object_only_scene(painted.capture), picture.sensor)
        inside = np.flatnonzero(look.covered == 1)
        shown, render = picture.photograph.mean(axis=2), np.minimum(render, 1).mean(axis=2)
        fits = {
            (x, y): np.corrcoef(np.roll(shown, (y, x), (0, 1)).flat[inside], render.flat[inside])
            for x in (-1, 0, 1) for y in (-1, 0, 1)
        }  # fmt: skip
        fits = {shift: float(matrix[0, 1]) for shift, matrix in fits.items()}
        assert fits.pop((0, 0)) > max(fits.values()) + 0.05  # photographs are noisy


def test_a_window_of_a_sensor_sees_the_same(vase: SimpleNamespace) -> None:
    """Points keep their position, relative to corner and pixel size of the window."""
    sensor = vase.capture.sensors[1]
    window = windowed_sensor(sensor, (7, -3), (60, 45), 1.75)
    place = dr.zeros(mi.SurfaceInteraction3f, vase.texels.count)
    place.p = vase.texels.position
    before, after = (np.array(each.sample_direction(place, mi.Point2f(0.5))[0].uv)
                     for each in (sensor, window))  # fmt: skip
    assert film_size(window) == (60, 45)
    wanted = (before - np.array([[7], [-3]])) * 1.75
    inside = ((wanted > 1) & (wanted < np.array([[59], [44]]))).all(axis=0)
    assert inside.sum() > 100
    np.testing.assert_allclose(after[:, inside], wanted[:, inside], atol=5e-3)


@pytest.mark.slow
def test_files_mark_texels_of_the_model(painted, by_truth, tmp_path) -> None:
    from svu_mi.core.io.exr import read_exr

    result, _ = by_truth
    write_filled(painted.capture, painted.field, result, tmp_path / "out")
    masks = read_exr(tmp_path / "out" / "filled.exr")
    texels = painted.field.texels
    inside = texels.inside()
    for name, flags in (("Y", result.filled), ("model", result.invented.reached)):
        np.testing.assert_array_equal(masks[name][inside] > 0, texels.to_image(flags)[inside])
    record = json.loads((tmp_path / "out" / "run.json").read_text())["result"]["model"]
    assert record["title"] == "the truth" and record["answers"][0]["source"] == "renders"
    assert record["answers"][0]["reached"] == int(result.invented.reached.sum())


def test_model_is_not_run_without_texels_to_fill(painted) -> None:
    model, everything = Truth(painted), np.ones(painted.field.texels.count, bool)
    filled = fill_by_diffusion(painted.capture, painted.field, everything, model)
    assert filled.field is painted.field and filled.invented is None and not model.asked


@pytest.mark.parametrize("options", [
    {"free": 51}, {"free": -1}, {"steps": 0}, {"views": 0}, {"side": 8}, {"seed": -1},
    {"steps": 2.5},
])  # fmt: skip
def test_options_are_checked(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        DiffusionOptions(**options)


def folder_of(path: Path, name: object = "MarigoldIntrinsicsPipeline", ext: str = "safetensors"):
    """Create a folder with the files of a model, but without weights."""
    for part in FOLDERS:
        (path / part).mkdir(parents=True)
        (path / part / f"model.{ext}").write_bytes(b"")
    (path / "model_index.json").write_text(json.dumps({"_class_name": name}))
    return path


def test_folders_are_identified_by_their_index(tmp_path) -> None:
    for name, family in FAMILIES.items():
        assert family_of(folder_of(tmp_path / name, name)) is family
    assert "noncommercial" in FAMILIES["StableDiffusionAOVMatEstPipeline"].licence


def test_other_folders_are_refused(tmp_path) -> None:
    with pytest.raises(OptionError, match="model_index.json is missing; pass an unchanged"):
        family_of(tmp_path)
    for number, name in enumerate(["StableDiffusionPipeline", None, 3, ["x"]]):
        with pytest.raises(SvuError, match="model_index.json: .*; use Marigold"):
            family_of(folder_of(tmp_path / str(number), name))
    index = tmp_path / "model_index.json"
    for text in ("{", "[1]", "[" * 100000, "\xff"):
        index.write_bytes(text.encode("latin-1"))
        with pytest.raises(CaptureError, match="model_index.json: (not a read|expected an)"):
            family_of(tmp_path)


def test_pickled_weights_are_refused(tmp_path) -> None:
    with pytest.raises(
        OptionError, match=r"unet: .* are pickled and could run any code, so they are not"
    ):
        require_model(folder_of(tmp_path / "bin", ext="bin"))


@pytest.mark.parametrize("name", ["torch", "diffusers", "transformers"])
def test_without_the_extra(tmp_path, monkeypatch, name: str) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(SvuEnvironmentError, match=rf"needs .*{name}.*'svu_mi\[diffusion\]'"):
        require_model(folder_of(tmp_path / "model"))


def test_the_command_refuses_before_any_work(tmp_path, capsys, monkeypatch) -> None:
    """Capture and textures do not exist and are not read; the older result is kept."""
    monkeypatch.setattr(load_weights, "NEEDED", ("a_torch_that_nobody_has",))
    out = tmp_path / "out"
    write_older(out, "inpaint", "run.json", ["filled.exr"])
    before = names(out)
    words = "inpaint", tmp_path / "none", "--recovered", tmp_path / "none", "-o", out
    said = {
        "model_index.json is missing": ("--model", tmp_path),
        "have no effect without --model": ("--steps", 20),
        "pip install 'svu_mi[diffusion]'": ("--model", folder_of(tmp_path / "model")),
    }
    for sentence, more in said.items():
        assert sentence in fails(capsys, *words, *more)
    assert names(out) == before and (out / "filled.exr").read_text() == "older"
