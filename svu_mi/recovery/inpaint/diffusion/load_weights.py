"""Weights from a folder that the user has: nothing is fetched, and no pickle is opened."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from svu_mi.errors import OptionError, SvuEnvironmentError, excerpt
from svu_mi.recovery.inpaint.diffusion.latent_diffusion import Model
from svu_mi.recovery.inpaint.diffusion.model_interface import Family, family_of

NEEDED = ("torch", "diffusers", "transformers")
PARTS = ("unet", "vae", "text_encoder")
# What PyTorch, diffusers, transformers and safetensors raise of files that do not fit.
BROKEN = (OSError, ValueError, TypeError, KeyError, RuntimeError, AttributeError, IndexError)


def require_model(folder: str | Path) -> Family:
    """Refuse what ``load_model`` would, as far as that is known without reading weights."""
    family = family_of(folder)
    for part in PARTS:
        if not any((Path(folder) / part).glob("*.safetensors")):
            raise OptionError(
                f"{Path(folder) / part}: there are no weights here as .safetensors; others, such "
                "as .bin, are pickled, could run any code, and are not opened."
            )
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise SvuEnvironmentError(
            f"Filling by diffusion needs {', '.join(missing)}, not installed here: pip install "
            "'svu_mi[diffusion]'."
        )
    return family


def load_model(folder: str | Path, device: str = "auto") -> Model:
    """Read the weights of a diffusion model that tells materials from a picture.

    Known are Marigold (intrinsics, appearance) and RGB<->X (RGB to X). Neither comes with svu_mi;
    each has a licence of its own, that of RGB<->X for noncommercial research only.
    """
    folder = Path(folder)
    family = require_model(folder)
    with _sentence(folder, family), _silence():
        import torch

        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        model = Model(family=family, device=device, **_parts(folder, family, device))
        _require_channels(model)
    return model


def _parts(folder: Path, family: Family, device: str) -> dict[str, Any]:
    import torch
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from transformers import CLIPTextModel, CLIPTokenizer

    kinds: tuple[Any, ...] = (UNet2DConditionModel, AutoencoderKL, CLIPTextModel)
    precision = torch.float16 if device.startswith("cuda") else torch.float32
    found: dict[str, Any] = {}
    for name, kind in zip(PARTS, kinds, strict=True):
        part = kind.from_pretrained(folder / name, local_files_only=True, use_safetensors=True)
        found[name] = part.to(device, precision).eval()
    scheduler = DDIMScheduler.from_pretrained(folder / "scheduler", local_files_only=True)
    return found | {
        "tokenizer": CLIPTokenizer.from_pretrained(folder / "tokenizer", local_files_only=True),
        "scheduler": DDIMScheduler.from_config(scheduler.config, **family.schedule),
    }


def _require_channels(model: Model) -> None:
    """Refuse weights that make something else, such as Marigold's decomposition of light."""
    latents = model.vae.config.latent_channels
    for run in model.family.runs:
        wanted = (len(run.maps) + 1) * latents, len(run.maps) * latents
        found = model.unet.config.in_channels, model.unet.config.out_channels
        if wanted != found:
            raise ValueError(
                f"its U-Net has {found[0]} channels in and {found[1]} out, not {wanted[0]} and "
                f"{wanted[1]}"
            )


@contextmanager
def _sentence(folder: Path, family: Family) -> Iterator[None]:
    """Say in a sentence what libraries raise of a folder."""
    try:
        yield
    except ImportError as error:
        raise SvuEnvironmentError(
            f"{', '.join(NEEDED)} are installed, but cannot be imported ({excerpt(error, 160)}); "
            "pip install -U 'svu_mi[diffusion]'."
        ) from error
    except BROKEN as error:
        raise OptionError(
            f"{folder}: cannot be used as {family.title} ({excerpt(error, 160)}); give the folder "
            "as it is published."
        ) from error


@contextmanager
def _silence() -> Iterator[None]:
    """Keep the bars and advice of diffusers and transformers away meanwhile."""
    from diffusers.utils import logging as diffusers
    from transformers.utils import logging as transformers

    libraries = (diffusers, transformers)
    levels = [library.get_verbosity() for library in libraries]
    try:
        for library in libraries:
            library.set_verbosity_error()
            library.disable_progress_bar()
        yield
    finally:
        for library, level in zip(libraries, levels, strict=True):
            library.set_verbosity(level)
            library.enable_progress_bar()
