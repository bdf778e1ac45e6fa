"""``svu inpaint``: fill what nobody saw of recovered textures, and say how sure that is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from svu_mi.cli.common import Output
from svu_mi.cli.inputs import FromPhotographs, Resolution, WithPictures
from svu_mi.cli.terminal import say
from svu_mi.cli.words import given
from svu_mi.errors import OptionError
from svu_mi.progress import Progress
from svu_mi.results.writing import claimed

if TYPE_CHECKING:
    from svu_mi.inpaint import Filled

From = Annotated[Path, tyro.conf.arg(metavar="FOLDER")]


@dataclass(frozen=True, kw_only=True)
class Inpaint(WithPictures, FromPhotographs):
    """Fill texels of recovered textures that no photograph shows, by what they are like.

    Near them, around an axis, or on the other side of a mirror: which of these the object is like
    is found out by hiding parts of it that were seen. Writes textures, recovered.xml,
    uncertainty.exr, filled.exr (1 where a texel was filled), filled.png and run.json.
    """

    work = "recover"
    fills = True
    output: Output = Path("out/filled")
    recovered: From
    """Folder that svu recover wrote."""
    resolution: tyro.conf.Suppress[Resolution] = (512,)  # that of the textures, in fact
    above: float = inf
    """Fill texels, too, of which a parameter's standard deviation is larger: what is known of them
    counts as much as it is certain. Without it, those that were never seen."""

    def run(self, console: Console) -> int:
        """Fill, and write the results."""
        from svu_mi.output.filled import fill_sentences

        self.check()
        with claimed(self.output, "svu inpaint"):
            self.start()
            found = self._run(Progress(console))
        say(console, f"Wrote {self.output}")
        for sentence in fill_sentences(found):
            say(console, sentence)
        return 0

    def check(self) -> None:
        """Refuse options that make no sense, before any work (see ``FromPhotographs``)."""
        super().check()
        if not self.above > 0:
            raise OptionError(f"--above must be positive, got {self.above}.")

    def _run(self, progress: Progress) -> Filled:
        from svu_mi.inpaint import fill
        from svu_mi.output.filled import write_filled
        from svu_mi.output.manifest import Run
        from svu_mi.output.textures import read_textures, require_textures_of
        from svu_mi.pipeline import estimate
        from svu_mi.recovery.field.make import field_around
        from svu_mi.surface.neighbors import neighbors

        textures = read_textures(self.recovered)
        sized = replace(self, resolution=textures.resolution)
        capture, texels = sized.load(progress)
        require_textures_of(capture, self.recovered)
        known = estimate(capture, texels, whole=True, progress=progress)
        with progress.stage("How sure the textures are"):
            field = field_around(textures, known, neighbors(texels, capture.mesh))
        with progress.stage("Looking for likeness"):
            found = fill(field, known.posterior.observed, self.above)
        with progress.stage("Writing the results"):
            run = Run(settings=given(self), kernels=progress.kernels)
            write_filled(capture, field, found, self.output, run, pictures=self.pictures)
        return found
