"""Names of the files of an exported asset, and what is said about each."""

from __future__ import annotations

from dataclasses import dataclass

TEXTURES = "textures"
RECORD = "asset.json"


@dataclass(frozen=True, kw_only=True)
class Written:
    """A file of an asset.

    Attributes:
        file: path, relative to the asset's folder.
        format: what kind of file.
        holds: what is in it.
        values: how its numbers are to be read.
    """

    file: str
    format: str
    holds: str
    values: str
