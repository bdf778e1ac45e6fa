"""Tiny random weights of Marigold and RGB<->X, in the layout of the originals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

FAMILIES = {"MarigoldIntrinsicsPipeline": 2, "StableDiffusionAOVMatEstPipeline": 1}  # maps of a run
LATENTS, WIDTH = 4, 32


def write_model(folder: Path, name: str, *, maps: int | None = None, safe: bool = True) -> Path:
    """Write a folder, and return it.

    Args:
        folder: made if missing.
        name: class of the pipeline, one of ``FAMILIES``.
        maps: of a run, if not as many as the family has.
        safe: weights as safetensors.
    """
    import torch
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    torch.manual_seed(1851304276)
    maps = FAMILIES[name] if maps is None else maps
    parts: dict[str, Any] = {
        "unet": UNet2DConditionModel(
            block_out_channels=(WIDTH, 2 * WIDTH), layers_per_block=1, sample_size=32,
            in_channels=(maps + 1) * LATENTS, out_channels=maps * LATENTS,
            down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
            up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
            cross_attention_dim=WIDTH, norm_num_groups=8,
        ),
        "vae": AutoencoderKL(
            block_out_channels=[WIDTH, WIDTH, 2 * WIDTH], in_channels=3, out_channels=3,
            down_block_types=["DownEncoderBlock2D"] * 3, up_block_types=["UpDecoderBlock2D"] * 3,
            latent_channels=LATENTS, norm_num_groups=8,
        ),
        "text_encoder": CLIPTextModel(CLIPTextConfig(
            bos_token_id=0, eos_token_id=1, pad_token_id=1, hidden_size=WIDTH,
            intermediate_size=37, num_attention_heads=4, num_hidden_layers=2, vocab_size=99,
        )),
    }  # fmt: skip
    for part, model in parts.items():
        model.save_pretrained(folder / part, safe_serialization=safe)
    schedule = DDIMScheduler(
        prediction_type="v_prediction", beta_schedule="scaled_linear", beta_start=0.00085,
        beta_end=0.012, clip_sample=False, set_alpha_to_one=False, steps_offset=1,
    )  # fmt: skip
    schedule.save_pretrained(folder / "scheduler")
    _write_tokenizer(folder / "tokenizer")
    (folder / "model_index.json").write_text(json.dumps({"_class_name": name}))
    return folder


def _write_tokenizer(folder: Path) -> None:
    """Write one that knows letters, and what begins and ends a text."""
    letters = [chr(code) for code in range(ord("a"), ord("z") + 1)] + ["(", ")"]
    words = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{x}</w>" for x in letters)]
    folder.mkdir(parents=True)
    (folder / "vocab.json").write_text(json.dumps({word: k for k, word in enumerate(words)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    (folder / "tokenizer_config.json").write_text(json.dumps({
        "tokenizer_class": "CLIPTokenizer", "model_max_length": 77, "pad_token": "<|endoftext|>",
        "unk_token": "<|endoftext|>", "bos_token": "<|startoftext|>",
        "eos_token": "<|endoftext|>",
    }))  # fmt: skip
