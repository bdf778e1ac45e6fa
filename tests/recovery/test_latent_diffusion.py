"""Filling by the classes of diffusers and transformers, with tiny random weights."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.helpers import run
from support.tiny_diffusion import write_model

from svu_mi.capture.image_io import decoded, srgb
from svu_mi.core.io.exr import read_exr
from svu_mi.errors import OptionError
from svu_mi.output.texture_files import read_textures
from svu_mi.recovery.inpaint.diffusion.latent_diffusion import LatentDiffusion
from svu_mi.recovery.inpaint.diffusion.load_weights import load_model
from svu_mi.recovery.inpaint.diffusion.model_interface import FAMILIES, ModelInput

pytestmark = pytest.mark.slow
MARIGOLD, RGBX = FAMILIES


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    """Use one thread: tiny layers do not profit from more."""
    # Here, since collecting the other tests does not need the seconds that these imports take.
    for name in ("torch", "diffusers", "transformers"):
        pytest.importorskip(name, reason="the extra diffusion is not installed")
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Weights of each family. Read only."""
    return {name: write_model(tmp_path_factory.mktemp("weights") / name, name) for name in FAMILIES}


@pytest.fixture(scope="module")
def recovered(shot: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Textures of ``shot``. Read only."""
    folder = tmp_path_factory.mktemp("recovered") / "textures"
    assert run("recover", shot, "--resolution", 32, "--steps", 20, "-o", folder) == 0
    return folder


def picture(height: int = 45, width: int = 60) -> ModelInput:
    """Noise with a certain left half."""
    random = np.random.default_rng(530619427)
    maps = {"base_color": random.random((height, width, 3)) * 0.2 + 0.4,
            "roughness": np.full((height, width), 0.3),
            "metallic": np.full((height, width), 0.8)}  # fmt: skip
    certain = np.broadcast_to(np.arange(width) < width // 2, (height, width))
    return ModelInput(random.random((height, width, 3)), maps, certain, None)


class Identity:
    """An autoencoder that only halves the resolution, so that certain pixels can be compared."""

    config = SimpleNamespace(scaling_factor=0.5, block_out_channels=(1, 1), latent_channels=3)

    def __init__(self) -> None:
        import torch

        self.dtype, self.functions = torch.float32, torch.nn.functional

    def encode(self, image: Any) -> SimpleNamespace:
        half = self.functions.avg_pool2d(image, 2)
        return SimpleNamespace(latent_dist=SimpleNamespace(mode=lambda: half))

    def decode(self, latent: Any, **_: bool) -> tuple[Any]:
        return (self.functions.interpolate(latent, scale_factor=2),)


class Recording:
    """A U-Net with constant output that records its inputs."""

    def __init__(self) -> None:
        self.given: list[tuple[Any, float, tuple[int, ...]]] = []

    def __call__(self, latents, time, encoder_hidden_states, **_):
        self.given.append((latents, float(time), tuple(encoder_hidden_states.shape)))
        rest = latents.shape[1] - 3
        return (0 * latents[:, :rest] + 0.1,)


@pytest.mark.parametrize("name", FAMILIES)
def test_models_are_given_what_their_pipelines_give_them(folders, name: str) -> None:
    """Order of latents, prompts, sRGB, schedule; certain pixels are reproduced."""
    model = load_model(folders[name], "cpu")
    unet, family = Recording(), model.family
    plain = LatentDiffusion(
        family, unet, Identity(), model.text_encoder, model.tokenizer, model.scheduler, "cpu"
    )
    given, counted = picture(), []
    result = plain.predict(given, 50, 0, 7, lambda: counted.append(1))
    assert len(unet.given) == len(counted) == 50 * model.runs
    latents, _, told = unet.given[0]
    maps = len(family.runs[0].maps)
    assert latents.shape[1] == 3 * (maps + 1)
    assert told[1] == (2 if name == MARIGOLD else 77)  # empty prompts are not padded there
    photograph = latents[:, :3] if name == MARIGOLD else latents[:, -3:]
    shown = given.photograph if name == RGBX else srgb(given.photograph)
    shown = np.pad(shown, [(0, 1), (0, 0), (0, 0)], mode="edge")
    half = shown.reshape(23, 2, 30, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(photograph[0].permute(1, 2, 0), half - 0.5, atol=1e-5)
    assert unet.given[0][1] == (999 if name == RGBX else 981)  # trailing, leading spacing
    first = given.maps["base_color"][:44, :30]
    first = first if name == RGBX else srgb(first)
    means = first.reshape(22, 2, 15, 2, 3).mean(axis=(1, 3)).repeat(2, 0).repeat(2, 1)
    got = result["base_color"][:44, :30]
    np.testing.assert_allclose(got if name == RGBX else srgb(got), means, atol=1e-3)
    np.testing.assert_allclose(result["roughness"][:, :30], 0.3, atol=1e-3)
    np.testing.assert_allclose(result["metallic"][:, :30], 0.8, atol=1e-3)
    assert np.abs(result["roughness"][:, 30:] - 0.3).max() > 0.05


@pytest.mark.parametrize("name", FAMILIES)
def test_the_same_seed_gives_the_same_maps(folders, name: str) -> None:
    model = load_model(folders[name], "cpu")
    first, again, other = (model.predict(picture(), 6, 2, seed) for seed in (3, 3, 4))
    for key, values in first.items():
        assert values.shape == picture().maps[key].shape
        assert np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1
        np.testing.assert_array_equal(values, again[key])
        assert np.abs(values - other[key]).max() > 0.01


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("name", FAMILIES)
def test_the_command_fills_by_a_model(shot, recovered, folders, tmp_path, capsys, name) -> None:
    """50 steps, as in the paper, on the CPU; seen texels and the seed are kept."""
    out, again = tmp_path / "filled", tmp_path / "again"
    words = "inpaint", shot, "--recovered", recovered, "--model", folders[name]
    words = *words, "--views", 2, "--side", 32, "--seed", 11
    assert run(*words, "-o", out) == 0
    assert "licence of its weights" in capsys.readouterr().out
    masks = read_exr(out / "filled.exr")
    inside = read_exr(recovered / "coverage.exr")["Y"]
    assert 0 < masks["model"].max() <= 1 and (masks["model"] <= masks["Y"]).all()
    assert masks["Y"][inside > 0].max() == 0
    before, after = (np.array(read_textures(each).roughness)[..., 0] for each in (recovered, out))
    np.testing.assert_allclose(after[inside > 0], before[inside > 0], atol=1e-6)
    assert np.abs(after - before)[masks["model"] > 0].max() > 0.05
    record = json.loads((out / "run.json").read_text())["result"]["model"]
    assert record["title"] == FAMILIES[name].title
    assert [answer["source"] for answer in record["answers"]] == ["renders"]
    if name != next(iter(FAMILIES)):  # the seed is used by the loop of all families
        return
    assert run(*words, "--no-pictures", "-o", again) == 0
    other = np.array(read_textures(again).roughness)[..., 0]
    np.testing.assert_allclose(after, other, atol=1e-3)


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files with their contents."""
    return {str(path.relative_to(folder)): path.read_bytes()
            for path in sorted(folder.rglob("*")) if path.is_file()}  # fmt: skip


@pytest.mark.usefixtures("variant")
def test_a_run_that_is_interrupted_leaves_the_older_result(
    shot, recovered, folders, tmp_path, capsys, monkeypatch
) -> None:
    out = tmp_path / "filled"
    assert run("inpaint", shot, "--recovered", recovered, "--no-pictures", "-o", out) == 0
    before = contents(out)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(LatentDiffusion, "predict", interrupted)
    words = "inpaint", shot, "--recovered", recovered, "--model", folders[MARIGOLD]
    assert run(*words, "--side", 32, "-o", out) == 130
    assert contents(out) == before and "run.json" in before


@pytest.mark.parametrize("spoil, sentence", [
    ("channels", "the U-Net has 16 input and 12 output channels instead of 12 and 8"),
    ("weights", "cannot be used as Marigold"),
    ("tokenizer", "cannot be used as Marigold"),
    ("scheduler", "cannot be used as Marigold"),
    ("config", "cannot be used as Marigold"),
    ("pickled", "are pickled and could run any code, so they are not opened"),
])  # fmt: skip
def test_broken_folders_are_refused(folders, tmp_path, spoil: str, sentence: str) -> None:
    folder = tmp_path / "weights"
    if spoil == "channels":
        write_model(folder, MARIGOLD, maps=3)
    else:
        shutil.copytree(folders[MARIGOLD], folder)
    if spoil == "weights":
        weights = folder / "unet" / "diffusion_pytorch_model.safetensors"
        weights.write_bytes(weights.read_bytes()[:1000])
    if spoil == "pickled":
        (folder / "vae" / "diffusion_pytorch_model.safetensors").unlink()
        import torch

        torch.save({}, folder / "vae" / "diffusion_pytorch_model.bin")
    if spoil in ("tokenizer", "scheduler"):
        shutil.rmtree(folder / spoil)
    if spoil == "config":
        (folder / "vae" / "config.json").write_text("{")
    with pytest.raises(OptionError) as caught:
        load_model(folder)
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


def test_missing_device_is_refused(folders) -> None:
    with pytest.raises(OptionError, match="cannot be used as Marigold"):
        load_model(folders[MARIGOLD], "a toaster")


def test_without_certain_pixels_it_equals_diffusers(folders) -> None:
    """The published loop of Marigold gives the same maps from the same noise."""
    import torch
    from diffusers import MarigoldIntrinsicsPipeline

    model = load_model(folders[MARIGOLD], "cpu")
    given = replace(picture(44, 60), certain=np.zeros((44, 60), bool))
    result = model.predict(given, 7, 2, 19)
    pipeline = MarigoldIntrinsicsPipeline(
        model.unet, model.vae, model.scheduler, model.text_encoder, model.tokenizer,
        prediction_type="intrinsics", default_denoising_steps=7, default_processing_resolution=0,
        target_properties={"target_names": ["albedo", "material"]},
    )  # fmt: skip
    pipeline.set_progress_bar_config(disable=True)
    noise = torch.randn((1, 8, 11, 15), generator=torch.Generator("cpu").manual_seed(19))
    shown = torch.from_numpy(srgb(given.photograph).astype(np.float32)).permute(2, 0, 1)[None]
    albedo, material = pipeline(shown, latents=noise, output_type="np").prediction
    np.testing.assert_allclose(result["base_color"], decoded(albedo), atol=1e-4)
    np.testing.assert_allclose(result["roughness"], material[..., 0], atol=1e-4)
    np.testing.assert_allclose(result["metallic"], material[..., 1], atol=1e-4)
