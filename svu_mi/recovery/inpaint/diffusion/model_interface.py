"""Diffusion models of materials: input, output, options, and known families.

All are latent diffusion models [Rombach et al. 2022] that are given a picture and denoise maps of
its materials:

    Marigold        one run makes albedo, and roughness and metallicity as channels of one picture;
                    no text; photograph and albedo in sRGB [Ke et al. 2025]
    RGB<->X         one run per map, which a text names; all in linear values [Zeng et al. 2024]

None is part of svu_mi, and each has its own licence (``Family.licence``).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from svu_mi.core.validation import require, require_ranges, require_types
from svu_mi.errors import OptionError, excerpt


@dataclass(frozen=True)
class ModelInput:
    """Input of a model for one view, h x w pixels.

    Attributes:
        photograph: (h, w, 3) linear, exposed so that 1 is white; in [0, 1].
        maps: by parameter, (h, w, 3) or (h, w), in [0, 1]: what is known of it where that is
            certain, a first guess elsewhere; 0 off the object.
        certain: (h, w) bool, pixels that show nothing but what is known.
        sensor: where from.
    """

    photograph: np.ndarray
    maps: Mapping[str, np.ndarray]
    certain: np.ndarray
    sensor: Any


class MaterialModel(Protocol):
    """Model that completes maps of material parameters in one view."""

    @property
    def title(self) -> str:
        """Name to print."""

    @property
    def licence(self) -> str:
        """Licence of the weights."""

    @property
    def runs(self) -> int:
        """Denoising runs per picture."""

    def predict(
        self, picture: ModelInput, steps: int, free: int, seed: int, after_step: Callable[[], None]
    ) -> Mapping[str, np.ndarray]:
        """Return maps of a picture as ``ModelInput.maps`` has them, by parameter, linear."""


INDEX = "model_index.json"
LARGEST_INDEX = 1 << 20  # bytes
COLOR = ("base_color",) * 3


@dataclass(frozen=True)
class DenoisingRun:
    """Maps that are denoised together.

    Attributes:
        text: prompt.
        maps: of each picture, the parameters that its three channels hold; None for nothing. A
            parameter of one value that has several channels is read from the first.
    """

    text: str
    maps: tuple[tuple[str | None, ...], ...]


@dataclass(frozen=True)
class Family:
    """Models of one kind.

    Attributes:
        title: to print.
        licence: of its published weights.
        runs: what it makes.
        photograph_first: whether the photograph's latent comes before those of the maps.
        encoded: what is in sRGB: ``photograph``, ``base_color``; all else is linear.
        schedule: settings of the noise schedule that its own folder does not have.
    """

    title: str
    licence: str
    runs: tuple[DenoisingRun, ...]
    photograph_first: bool
    encoded: frozenset[str]
    schedule: Mapping[str, Any]


# By the name of the pipeline that the folder says it is for.
FAMILIES = {
    "MarigoldIntrinsicsPipeline": Family(
        title="Marigold (intrinsics, appearance)",
        licence="see the model card in their folder (of v1.1: CreativeML Open RAIL++-M)",
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
    """Return the family of the weights in a folder, by its index."""
    index = Path(folder) / INDEX
    known = " or ".join(family.title for family in FAMILIES.values())
    try:
        if not index.is_file():
            raise OptionError(
                f"{folder}: there is no {INDEX} in this folder; give the folder of the weights of "
                f"{known}, as they are published."
            )
        if index.stat().st_size > LARGEST_INDEX:
            raise OptionError(f"{index}: has more than {LARGEST_INDEX} bytes, and is no index.")
        record = json.loads(index.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise OptionError(f"{index}: cannot be read ({excerpt(error, 80)}).") from error
    name = record.get("_class_name") if isinstance(record, dict) else None
    if not isinstance(name, str) or name not in FAMILIES:
        raise OptionError(
            f"{index}: is for {excerpt(name, 60)}, which is not known here; give the weights of "
            f"{known}."
        )
    return FAMILIES[name]


@dataclass(frozen=True, kw_only=True)
class DiffusionOptions:
    """Options of a diffusion model."""

    views: int = 8
    """Pictures that it is asked about, at most: fewer if they show all there is to fill. Of what
    photographs show, these are photographs; of what none shows, renders."""

    steps: int = 50
    """Steps of the diffusion."""

    free: int = 10
    """Of these, the last ones in which what is known is not put back."""

    side: int = 768
    """Pixels of the longer side of a picture, which is never larger than a photograph."""

    seed: int = 0
    """Of the noise: the same seed, the same textures."""

    device: str = "auto"
    """Where the model runs, as PyTorch names it: cpu, cuda, cuda:1; auto takes a GPU if there is
    one."""

    def __post_init__(self) -> None:
        require_types(self)
        require_ranges(self, views=(1, 100), steps=(1, 1000), side=(32, 4096))
        require(self, 0 <= self.free <= self.steps, "free", f"in [0, {self.steps}], the steps")
        require(self, 0 <= self.seed < 2**32, "seed", "in [0, 2^32)")
