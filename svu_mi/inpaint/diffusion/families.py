"""Which models can be asked, how they differ, and which one a folder of weights holds.

All are latent diffusion models [Rombach et al. 2022] that are given a picture and denoise maps of
its materials:

    Marigold        one run makes albedo, and roughness and metallicity as channels of one picture;
                    no text; photograph and albedo in sRGB [Ke et al. 2025]
    RGB<->X         one run per map, which a text names; all in linear values [Zeng et al. 2024]

None is part of svu_mi, and each has its own licence (``Family.licence``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from svu_mi.errors import OptionError, excerpt

INDEX = "model_index.json"
LARGEST_INDEX = 1 << 20  # bytes
COLOR = ("base_color",) * 3


@dataclass(frozen=True)
class Run:
    """Maps that are denoised together.

    Attributes:
        text: that the model is told.
        maps: of each picture, the parameters that its three channels hold; None for nothing. A
            parameter of one value that has several channels is read from the first.
    """

    text: str
    maps: tuple[tuple[str | None, ...], ...]


@dataclass(frozen=True)
class Family:
    """Models of one kind.

    Attributes:
        title: for people.
        licence: of its published weights, for people.
        runs: what it makes.
        photograph_first: whether the photograph's latent comes before those of the maps.
        encoded: what is in sRGB: ``photograph``, ``base_color``; all else is linear.
        schedule: settings of the noise schedule that its own folder does not have.
    """

    title: str
    licence: str
    runs: tuple[Run, ...]
    photograph_first: bool
    encoded: frozenset[str]
    schedule: Mapping[str, Any]


# By the name of the pipeline that the folder says it is for.
FAMILIES = {
    "MarigoldIntrinsicsPipeline": Family(
        title="Marigold (intrinsics, appearance)",
        licence="see the model card in their folder (of v1.1: CreativeML Open RAIL++-M)",
        runs=(Run("", (COLOR, ("roughness", "metallic", None))),),
        photograph_first=True,
        encoded=frozenset({"photograph", "base_color"}),
        schedule={},
    ),
    "StableDiffusionAOVMatEstPipeline": Family(
        title="RGB<->X (RGB to X)",
        licence="Adobe Research License, for noncommercial research only",
        runs=(
            Run("Albedo (diffuse basecolor)", (COLOR,)),
            Run("Roughness", (("roughness",) * 3,)),
            Run("Metallicness", (("metallic",) * 3,)),
        ),
        photograph_first=False,
        encoded=frozenset(),
        schedule={"rescale_betas_zero_snr": True, "timestep_spacing": "trailing"},
    ),
}


def family_of(folder: str | Path) -> Family:
    """Return which kind of weights a folder holds; nothing else of it is read.

    Raises:
        OptionError: it holds none, or none that are known here.
    """
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
