"""Loading of diffusion model weights from a local folder, without pickles."""

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
# Errors that PyTorch, diffusers, transformers and safetensors raise for invalid files.
BROKEN = (OSError, ValueError, TypeError, KeyError, RuntimeError, AttributeError, IndexError)


def require_model(folder: str | Path) -> Family:
    """Validate a folder of weights without reading them (errors as ``load_model``)."""
    family = family_of(folder)
    for part in FOLDERS:
        if not any((Path(folder) / part).glob("*.safetensors")):
            raise OptionError(
                f"{Path(folder) / part}: contains no .safetensors file; other formats, such as "
                ".bin, are pickled and could run any code, so they are not opened."
            )
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise SvuEnvironmentError(
            f"Filling by diffusion needs packages that are not installed: {', '.join(missing)}. "
            "Run: pip install 'svu_mi[diffusion]'."
        )
    return family


def load_model(folder: str | Path, device: str = "auto") -> LatentDiffusion:
    """Read the weights of a diffusion model that estimates materials from an image.

    Supported models: Marigold (intrinsics, appearance) and RGB<->X (RGB to X). svu_mi contains
    neither. The licence of RGB<->X permits noncommercial research only.

    Raises:
        SvuEnvironmentError: A package is not installed, or cannot be imported.
        OptionError: The folder does not contain valid weights of a supported model.
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
    """Raise a ValueError for weights with other outputs, such as Marigold's lighting."""
    latents = model.vae.config.latent_channels
    for run in model.family.runs:
        wanted = (len(run.maps) + 1) * latents, len(run.maps) * latents
        channels = model.unet.config.in_channels, model.unet.config.out_channels
        if wanted != channels:
            raise ValueError(
                f"the U-Net has {channels[0]} input and {channels[1]} output channels instead of "
                f"{wanted[0]} and {wanted[1]}"
            )


@contextmanager
def _readable_errors(folder: Path, family: Family) -> Iterator[None]:
    """Convert errors of the libraries to svu_mi errors that name the folder."""
    try:
        yield
    except ImportError as error:
        raise SvuEnvironmentError(
            f"{', '.join(NEEDED)} are installed, but cannot be imported ({excerpt(error, 160)}); "
            "run: pip install --upgrade 'svu_mi[diffusion]'."
        ) from error
    except BROKEN as error:
        raise OptionError(
            f"{folder}: cannot be used as {family.title} ({excerpt(error, 160)}); pass an "
            "unchanged copy of the published folder."
        ) from error


@contextmanager
def _quiet_libraries() -> Iterator[None]:
    """Disable progress bars and warnings of diffusers and transformers."""
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
