"""What workers are told: which photographs, and which sums of what they say.

Everything here goes from process to process: names, numbers, and paths of files that all of them
can read.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from svu_mi import __version__
from svu_mi.capture.fingerprint import Key
from svu_mi.options import AngularPreset
from svu_mi.surface import Texels

Kind = Literal["survey", "statistics", "rounding"]


@dataclass(frozen=True, kw_only=True)
class Job:
    """A capture in shards.

    Attributes:
        folder: of the partial sums; absolute, and the same for all workers.
        load: arguments of ``load_capture``; paths are absolute.
        light: of the capture, a folder that ``svu light`` wrote or a map; None for the scene's own.
        resolution: of the texels, (W, H).
        texels: digest of them (``texels_key``), which workers must find, too.
        shards: numbers of each one's views.
        variant: of Mitsuba.
        key: digest of all of this, and of the files.
        scene: digest of shapes and light (``scene_key``), which workers must find, too.
        exposures: of all photographs, likewise.
    """

    folder: Path
    load: dict[str, Any] = field(repr=False)
    light: Path | None
    resolution: tuple[int, int]
    texels: str
    shards: tuple[tuple[int, ...], ...]
    variant: str
    key: str
    scene: str
    exposures: tuple[float, ...] = field(repr=False)


def texels_key(texels: Texels) -> str:
    """Return a digest of which texels lie where on a mesh."""
    return Key(texels.index.numpy(), texels.face.numpy()).digest()


@dataclass(frozen=True, kw_only=True)
class Ask:
    """Which sums are asked for.

    Attributes:
        kind: ``survey`` finds out which views see which texels; what the others are of is known
            only then.
        inputs: file with the numbers of texels, and the models of clipped samples (``Weighting``).
        lit_for: number of photographs that the light is filtered for (``Evidence``).
        roughness: levels.
        switches: the reflection model.
        channels: of the photographs.
        light_channels: of the light.
        kappa, edges: how much samples count (``Weighting``).
    """

    kind: Kind
    inputs: Path | None = None
    lit_for: int = 0
    roughness: tuple[float, ...] = ()
    switches: AngularPreset | None = None
    channels: int = 3
    light_channels: int = 3
    kappa: float = float("inf")
    edges: float = 0.0

    @property
    def key(self) -> str:
        """Digest of what is asked; inputs are named by theirs."""
        words = [
            __version__, self.kind, "" if self.inputs is None else self.inputs.name, self.lit_for,
            list(self.roughness), repr(self.switches), self.channels, self.light_channels,
            float(self.kappa), float(self.edges),
        ]  # fmt: skip
        return Key(words).digest()[:16]


@dataclass(frozen=True)
class Task:
    """The sums of one shard.

    Attributes:
        job: the capture.
        shard: its number.
        ask: which sums.
    """

    job: Job
    shard: int
    ask: Ask

    @property
    def path(self) -> Path:
        """File that gets the sums."""
        return self.job.folder / f"{self.ask.kind}-{self.ask.key}-{self.shard:04d}.npz"


@dataclass(frozen=True)
class Done:
    """What became of a task.

    Attributes:
        shard: its number.
        made: whether it was done now, not before.
        worker: address of who did it; empty for this process.
    """

    shard: int
    made: bool
    worker: str = ""
