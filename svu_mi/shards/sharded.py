"""What photographs say of texels, summed up shard by shard."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.fingerprint import Key
from svu_mi.errors import OptionError
from svu_mi.evidence import Evidence, OfAllViews, Wanted
from svu_mi.interop import owned
from svu_mi.npz import read_arrays, write_arrays
from svu_mi.options import AngularPreset
from svu_mi.progress import Progress
from svu_mi.shards.cluster import run
from svu_mi.shards.job import Ask, Job, Task
from svu_mi.shards.work import is_whole
from svu_mi.statistics import Statistics
from svu_mi.statistics.gather import Weighting
from svu_mi.visibility.survey import mean_radiance


@dataclass
class Tally:
    """Who has done what.

    Attributes:
        made: number of sums that were made, and not found on disk.
        homes: workers that have loaded shards, by shard.
    """

    made: int = 0
    homes: dict[int, str] = field(default_factory=dict)


@dataclass(eq=False, kw_only=True)
class Sharded(Evidence):
    """Photographs in shards, whose sums are asked for when they are needed, and added in order.

    ``svu.estimate`` takes it for a capture. What needs photographs themselves (power spectra,
    guidance, recovery) cannot be had of it.

    Attributes:
        job: the capture, and its shards.
        merged: what all views see.
        client: a ``distributed.Client``; None for this process.
        progress: shows what is going on.
        tally: who has done what.
    """

    job: Job
    merged: OfAllViews
    client: Any = field(repr=False)
    progress: Progress = field(repr=False)
    tally: Tally

    @property
    def all_views(self) -> OfAllViews:
        """What all photographs together show (see ``Evidence``)."""
        return self.merged

    def prepare(self, switches: AngularPreset, progress: Progress) -> None:
        """Do nothing: workers trace what they need."""

    def clear(self) -> None:
        """Delete the partial sums."""
        for path in self.job.folder.iterdir():
            path.unlink()
        self.job.folder.rmdir()

    @cached_property
    def _used(self) -> int:
        return sum(self.capture.used)

    def _gather(self, wanted: Wanted) -> Statistics:
        weighting, switches = wanted.weighting, wanted.switches
        if weighting.current is not None:
            raise OptionError("Samples in shards cannot be weighted again; load the capture.")
        if switches.fit is not None:
            raise OptionError(
                f"Preset {switches.name!r} fits the light that all photographs together mirror, so "
                "its sums do not add; omit the shards, or use default, fixed or fast."
            )
        texels = self.seen if wanted.texels is None else wanted.texels
        ask = replace(
            self._ask("statistics", texels, weighting),
            roughness=tuple(map(float, wanted.roughness)), switches=switches,
            channels=wanted.channels, light_channels=wanted.light_channels,
        )  # fmt: skip
        sums, counts = (np.zeros(0), np.zeros(0, np.float32))
        for part in self._parts(ask):
            if part and not len(sums):
                sums, counts = part["sums"], part["counts"]
            elif part:
                sums += part["sums"]
                counts += part["counts"]
        return Statistics(
            owned(mi.Float64, sums), owned(mi.Float, counts),
            owned(mi.UInt32, texels.astype(np.uint32)), np.asarray(wanted.roughness),
            wanted.channels, weighting.kappa, weighting.edges,
        )  # fmt: skip

    def _rounded(self, weighting: Weighting) -> np.ndarray | None:
        total: np.ndarray | None = None
        for part in self._parts(self._ask("rounding", self.seen, weighting)):
            if part:
                total = part["total"] if total is None else total + part["total"]
        return total

    def _ask(self, kind: Any, texels: np.ndarray, weighting: Weighting) -> Ask:
        """Return what is asked of some texels, which are put where workers find them."""
        arrays = {"texels": np.asarray(texels, np.int64)}
        if weighting.models is not None:
            arrays["models"] = weighting.models.values.numpy()
            arrays["sigma"] = weighting.models.sigma.numpy()
        path = self.job.folder / f"inputs-{Key(arrays).digest()[:16]}.npz"
        if not is_whole(path):
            write_arrays(path, arrays)
        return Ask(
            kind=kind, inputs=path, lit_for=self._used, kappa=float(weighting.kappa),
            edges=float(weighting.edges),
        )  # fmt: skip

    def _parts(self, ask: Ask) -> Iterator[dict[str, np.ndarray]]:
        return parts(self.client, self.job, ask, self.tally, self.progress)


NAMES = {
    "survey": "Tracing visibility", "statistics": "Gathering in shards",
    "rounding": "Gathering in shards",
}  # fmt: skip


def parts(
    client: Any, job: Job, ask: Ask, tally: Tally, progress: Progress
) -> Iterator[dict[str, np.ndarray]]:
    """Have all shards make sums; yield them in order, one at a time."""
    tasks = [Task(job, shard, ask) for shard in range(len(job.shards))]
    with progress.stage(NAMES[ask.kind], len(tasks)) as stage:
        for done in run(client, tasks, tally.homes, stage.update):
            tally.made += done.made
            if done.worker:
                tally.homes[done.shard] = done.worker
    for task in tasks:
        yield read_sums(task.path)


def read_sums(path: Path) -> dict[str, np.ndarray]:
    """Read partial sums that a worker has reported.

    Raises:
        OptionError: they are not there: worker and client see different files.
    """
    try:
        return read_arrays(path)
    except ValueError as error:
        raise OptionError(
            f"{path}: a worker has written it, but it cannot be read here ({error}); give a folder "
            "that all workers and this process share."
        ) from error


def merged(found: Sequence[dict[str, np.ndarray]]) -> OfAllViews:
    """Put together what the views of all shards see."""
    names = {name for part in found for name in part}
    coverage = _sum("coverage", found, np.uint32)
    total = _sum("total", found, np.float64)
    return OfAllViews(
        coverage=coverage,
        clipped=_sum("clipped", found, np.uint32) if "clipped" in names else None,
        per_view=np.concatenate([part["per_view"] for part in found]),
        grey=all(bool(part["grey"]) for part in found),
        scale=mean_radiance(coverage, total),
    )


def _sum(name: str, found: Sequence[dict[str, np.ndarray]], kind: Any) -> np.ndarray:
    return np.sum([part[name] for part in found if name in part], axis=0, dtype=kind)  # type: ignore[no-any-return]
