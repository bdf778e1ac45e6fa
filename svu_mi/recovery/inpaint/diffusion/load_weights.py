"""Load the weights of a diffusion model from a local folder, without pickles."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from svu_mi.errors import OptionError, SvuEnvironmentError, excerpt
from svu_mi.recovery.inpaint.diffusion.latent_diffusion import LatentDiffusion
from svu_mi.recovery.inpaint.diffusion.model_interface import Family, family_of

NEEDED = ("torch", "diffusers", "transformers")
FOLDERS = ("unet", "vae", "text_encoder")
# What PyTorch, diffusers, transformers and safetensors raise of files that do not fit.
BROKEN = (OSError, ValueError, TypeError, KeyError, RuntimeError, AttributeError, IndexError)


def require_model(folder: str | Path) -> Family:
    """Check a folder of weights without reading them, with the errors of ``load_model``."""
    family = family_of(folder)
    for part in FOLDERS:
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


def load_model(folder: str | Path, device: str = "auto") -> LatentDiffusion:
    """Read the weights of a diffusion model that estimates materials from a picture.

    Known are Marigold (intrinsics, appearance) and RGB<->X (RGB to X). Neither comes with svu_mi;
    each has a licence of its own, that of RGB<->X for noncommercial research only.
    """
    folder = Path(folder)
    family = require_model(folder)
    with _readable_errors(folder, family), _quiet_libraries():
        import torch

        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        model = LatentDiffusion(family=family, device=device, **_load_parts(folder, family, device))
        _require_channels(model)
    return model


def _load_parts(folder: Path, family: Family, device: str) -> dict[str, Any]:
    import torch
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from transformers import CLIPTextModel, CLIPTokenizer

    kinds: tuple[Any, ...] = (UNet2DConditionModel, AutoencoderKL, CLIPTextModel)
    precision = torch.float16 if device.startswith("cuda") else torch.float32
    modules: dict[str, Any] = {}
    for name, kind in zip(FOLDERS, kinds, strict=True):
        module = kind.from_pretrained(folder / name, local_files_only=True, use_safetensors=True)
        modules[name] = module.to(device, precision).eval()
    scheduler = DDIMScheduler.from_pretrained(folder / "scheduler", local_files_only=True)
    return modules | {
        "tokenizer": CLIPTokenizer.from_pretrained(folder / "tokenizer", local_files_only=True),
        "scheduler": DDIMScheduler.from_config(scheduler.config, **family.schedule),
    }


def _require_channels(model: LatentDiffusion) -> None:
    """Refuse weights with other outputs, such as Marigold's decomposition of light."""
    latents = model.vae.config.latent_channels
    for run in model.family.runs:
        wanted = (len(run.maps) + 1) * latents, len(run.maps) * latents
        channels = model.unet.config.in_channels, model.unet.config.out_channels
        if wanted != channels:
            raise ValueError(
                f"its U-Net has {channels[0]} channels in and {channels[1]} out, not {wanted[0]} "
                f"and {wanted[1]}"
            )


@contextmanager
def _readable_errors(folder: Path, family: Family) -> Iterator[None]:
    """Translate errors of the libraries into one sentence about the folder."""
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
def _quiet_libraries() -> Iterator[None]:
    """Silence progress bars and advice of diffusers and transformers."""
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
