"""Options of commands that can sum photographs up in shards, here or on a cluster."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from svu_mi.cli.inputs import Estimated
from svu_mi.cli.words import pair, parse_known
from svu_mi.errors import OptionError
from svu_mi.progress import Progress

if TYPE_CHECKING:
    from svu_mi.capture import Capture
    from svu_mi.options import Skip
    from svu_mi.pipeline import Estimate

FOLDER = "shards"  # in the output folder, until the results are written
MOST = 10_000
Address = Annotated[str, tyro.conf.arg(metavar="ADDRESS")]


@dataclass(frozen=True, kw_only=True)
class InShards(Estimated):
    """Options of a command that can work on shards of the photographs."""

    shards: int = 0
    """Share the photographs out in so many parts, whose sums are kept in the output folder until
    all are there: a run that was stopped goes on. 0 keeps all photographs together."""
    scheduler: Address = ""
    """Address of a Dask scheduler, such as tcp://10.0.0.5:8786, whose workers make the sums; they
    see the same files. By default they are made here, one after the other."""

    def check(self) -> None:
        """Refuse options that make no sense, before any work (see ``Estimated``)."""
        super().check()
        if not 0 <= self.shards <= MOST:
            raise OptionError(f"--shards must be in 0 ... {MOST}, got {self.shards}.")
        if self.scheduler and not self.shards:
            raise OptionError("--scheduler hands shards out; say how many, such as --shards 8.")
        if not self.shards:
            return
        refused = {
            "--render": self.render, "--gains estimate": self.gains != "given",
            "--method spectrum": self.method != "angular", "--preset paper": self.preset == "paper",
        }  # fmt: skip
        for option, is_given in refused.items():
            if is_given:
                raise OptionError(
                    f"--shards and {option} do not go together, because that needs all photographs "
                    "in one place; omit one of them."
                )

    def estimate_in_shards(self, progress: Progress, skip: Skip) -> tuple[Capture, Estimate]:
        """Return the capture without its photographs, and what they say.

        Raises:
            SvuError: as those of ``load`` and ``gather_shards``.
        """
        from svu_mi.capture import load_capture
        from svu_mi.capture.folder import require_apart
        from svu_mi.pipeline import estimate
        from svu_mi.shards import gather_shards
        from svu_mi.shards.cluster import connected
        from svu_mi.surface import texels

        if self.fills:
            require_apart(self.output, self.scene)
        with progress.stage("Loading the scene"):
            capture = load_capture(
                self.scene, self.images, shape=self.shape, defines=self.defines(),
                unwrap=self.unwrap, missing=self.missing, trust=self.trust, light="optional",
                detail=self.detail(), views=(),
            )  # fmt: skip
            grid = texels(capture.mesh, pair(self.resolution, "--resolution"))
        with connected(self.scheduler) as client:
            sums = gather_shards(
                client, capture, grid, shards=self.shards, light=self.light,
                folder=self.output / FOLDER, progress=progress,
            )  # fmt: skip
            found = estimate(
                sums, None, self.method, self.preset, known=parse_known(self.known), skip=skip,
                progress=progress,
            )  # fmt: skip
        progress.say(f"{sums.tally.made} sums of {len(sums.job.shards)} shards were made now.")
        return sums.capture, found

    def clear_shards(self) -> None:
        """Delete partial sums, once what they are for is written; nothing else lies in folders
        that have a log of workers."""
        import shutil

        from svu_mi.shards.work import LOG

        if self.shards:
            for log in (self.output / FOLDER).glob(f"{'[0-9a-f]' * 16}/{LOG}"):
                shutil.rmtree(log.parent, ignore_errors=True)
            with suppress(OSError):
                (self.output / FOLDER).rmdir()  # only if it is empty
