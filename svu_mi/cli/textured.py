"""The option of commands that show recovered textures: what these are, and of which size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Self

import tyro

from svu_mi.cli.inputs import Estimated, Missing, Resolution
from svu_mi.cli.words import pair
from svu_mi.errors import OptionError
from svu_mi.progress import Progress

if TYPE_CHECKING:
    from svu_mi.capture import Capture
    from svu_mi.recovery.textures import Textures
    from svu_mi.surface import Texels

Recovered = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]


@dataclass(frozen=True, kw_only=True)
class Textured(Estimated):
    """Options of commands that show recovered textures beside what is known."""

    side: ClassVar[int] = 512
    """Texels per side where neither the textures nor the caller say."""
    recovered: Recovered = None
    """Folder that svu recover wrote, to show its textures."""
    resolution: Resolution = ()
    """Texels per side, or width and height; by default those of --recovered, else 512."""

    def check(self) -> None:
        """Refuse options that make no sense, before any work (see ``Estimated``)."""
        if self.resolution:
            super().check()
        else:
            replace(self, resolution=(self.side,)).check()

    def sized(self) -> tuple[Self, Textures | None]:
        """Return the command with a resolution, and the textures.

        Raises:
            CaptureError: the folder of the textures has none, or they cannot be read.
            OptionError: they have another resolution than the one asked for.
        """
        from svu_mi.output.textures import read_textures

        if self.recovered is None:
            return replace(self, resolution=self.resolution or (self.side,)), None
        textures = read_textures(self.recovered)
        if self.resolution and pair(self.resolution, "--resolution") != textures.resolution:
            width, height = textures.resolution
            raise OptionError(
                f"{self.recovered}: the textures have {width} x {height} texels; omit "
                "--resolution, which is theirs."
            )
        return replace(self, resolution=textures.resolution), textures

    def load(
        self, progress: Progress, *, again: bool = False, missing: Missing | None = None
    ) -> tuple[Capture, Texels]:
        """Load the photographs (see ``FromPhotographs``), which the textures have to fit.

        Raises:
            CaptureError: the textures were recovered over another mesh.
        """
        from svu_mi.output.textures import require_textures_of

        capture, texels = super().load(progress, again=again, missing=missing)
        if self.recovered is not None:
            require_textures_of(capture, self.recovered)
        return capture, texels
