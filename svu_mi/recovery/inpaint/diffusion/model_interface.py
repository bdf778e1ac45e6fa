"""Diffusion models of materials: input, output, options, and supported families.

All families are latent diffusion models [Rombach et al. 2022] that predict material maps:

    Marigold        one run for albedo and an image with roughness and metallic as channels;
                    no prompt; photograph and albedo in sRGB [Ke et al. 2025]
    RGB<->X         one run per map, selected by a prompt; all values linear [Zeng et al. 2024]

svu_mi contains no weights. Each family has its own licence (``Family.licence``).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from svu_mi.core.io.schema import TEXT, Field, read_record
from svu_mi.core.validation import require, require_ranges, require_types
from svu_mi.errors import OptionError, excerpt


@dataclass(frozen=True)
class ModelInput:
    """Input of a model for one view of h x w pixels.

    Attributes:
        photograph: (h, w, 3), linear RGB in [0, 1], exposed such that 1 is white.
        maps: Maps by parameter, (h, w, 3) or (h, w), in [0, 1]: known values where ``certain``,
            initial guesses elsewhere; 0 in the background.
        certain: (h, w) bool, True for pixels that show known texels only.
        sensor: Sensor of the view.
    """

    photograph: np.ndarray
    maps: Mapping[str, np.ndarray]
    certain: np.ndarray
    sensor: Any


class MaterialModel(Protocol):
    """Protocol of models that complete maps of material parameters in one view."""

    @property
    def title(self) -> str:
        """Title of the model."""

    @property
    def licence(self) -> str:
        """Licence of the weights."""

    @property
    def runs(self) -> int:
        """Number of denoising runs per image."""

    def predict(
        self, picture: ModelInput, steps: int, free: int, seed: int, after_step: Callable[[], None]
    ) -> Mapping[str, np.ndarray]:
        """Return completed linear maps, by parameter (shapes as ``ModelInput.maps``)."""


INDEX = "model_index.json"
COLOR = ("base_color",) * 3


@dataclass(frozen=True)
class DenoisingRun:
    """Denoising run, which may produce several images.

    Attributes:
        text: Prompt.
        maps: Parameter of each of the three channels, per output image; None if unused. Scalar
            parameters in several channels are read from the first.
    """

    text: str
    maps: tuple[tuple[str | None, ...], ...]


@dataclass(frozen=True)
class Family:
    """Family of diffusion models with the same inputs and outputs.

    Attributes:
        title: Title of the family.
        licence: Licence of the published weights.
        runs: Denoising runs per image.
        photograph_first: True if the photograph's latent precedes the maps in the input.
        encoded: Names of the inputs and outputs in sRGB, such as ``photograph``; others are linear.
        schedule: Settings of the noise schedule that replace published ones.
    """

    title: str
    licence: str
    runs: tuple[DenoisingRun, ...]
    photograph_first: bool
    encoded: frozenset[str]
    schedule: Mapping[str, Any]


# By ``_class_name`` in the index of the folder.
FAMILIES = {
    "MarigoldIntrinsicsPipeline": Family(
        title="Marigold (intrinsics, appearance)",
        licence="see the model card in the folder (v1.1: CreativeML Open RAIL++-M)",
        runs=(DenoisingRun("", (COLOR, ("roughness", "metallic", None))),),
        photograph_first=True,
        encoded=frozenset({"photograph", "base_color"}),
        schedule={},
    ),
    "StableDiffusionAOVMatEstPipeline": Family(
        title="RGB<->X (RGB to X)",
        licence="Adobe Research License, for noncommercial research only",
        runs=(
            DenoisingRun("Albedo (diffuse basecolor)", (COLOR,)),
            DenoisingRun("Roughness", (("roughness",) * 3,)),
            DenoisingRun("Metallicness", (("metallic",) * 3,)),
        ),
        photograph_first=False,
        encoded=frozenset(),
        schedule={"rescale_betas_zero_snr": True, "timestep_spacing": "trailing"},
    ),
}


def family_of(folder: str | Path) -> Family:
    """Return the family of the weights in a folder, identified by its index file."""
    index = Path(folder) / INDEX
    known = " or ".join(family.title for family in FAMILIES.values())
    if not index.is_file():
        raise OptionError(
            f"{folder}: {INDEX} is missing; pass an unchanged copy of the published folder of "
            f"{known}."
        )
    name = read_record(index, {"_class_name": Field(TEXT)}, f"use {known}")["_class_name"]
    if name not in FAMILIES:
        raise OptionError(f"{index}: model {excerpt(name, 60)} is not supported; use {known}.")
    return FAMILIES[name]


@dataclass(frozen=True, kw_only=True)
class DiffusionOptions:
    """Options of filling by a diffusion model.

    Example:
        >>> svu.DiffusionOptions(views=4, device="cpu").steps
        50
    """

    views: int = 8
    """Maximum number of images per kind (photographs of uncertain texels, renders of unseen ones),
    1 to 100. Raise it if texels of complex objects remain filled by symmetry."""

    steps: int = 50
    """Number of diffusion steps, 1 to 1000. Lower it to save time, at lower quality."""

    free: int = 10
    """Number of last steps, 0 to ``steps``, in which known pixels are not restored. Raise it if
    seams are visible around filled regions."""

    side: int = 768
    """Pixels of the longer side of an image, 32 to 4096; photographs are never enlarged. Lower it
    if memory is short."""

    seed: int = 0
    """Seed of the noise, 0 to 2^32 - 1. Change it for another plausible result."""

    device: str = "auto"
    """PyTorch device of the model, such as cpu, cuda or cuda:1. auto: the GPU if available."""

    def __post_init__(self) -> None:
        require_types(self)
        require_ranges(self, views=(1, 100), steps=(1, 1000), side=(32, 4096))
        require(self, 0 <= self.free <= self.steps, "free", f"in [0, {self.steps}], the steps")
        require(self, 0 <= self.seed < 2**32, "seed", "in [0, 2^32)")
