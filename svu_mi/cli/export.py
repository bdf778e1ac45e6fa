"""``svu export``: recovered textures for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from svu_mi.cli.base_command import ResultCommand
from svu_mi.cli.loading import require_memory
from svu_mi.cli.shared_options import Output
from svu_mi.core.io.output_folder import Claim
from svu_mi.core.memory import Need, Sizes
from svu_mi.core.progress import Progress

if TYPE_CHECKING:
    from svu_mi.output.export.write_asset import ExportOptions

Result = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")]
Format = Literal["exr", "png", "glb", "xml", "materialx"]
Formats = Annotated[tuple[Format, ...], tyro.conf.arg(metavar="{exr,png,glb,xml,materialx} ...")]
Maps = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]
Gutter = Annotated[int | None, tyro.conf.arg(metavar="TEXELS")]


@dataclass(frozen=True, kw_only=True)
class Export(ResultCommand):
    """Write recovered textures for Blender, Mitsuba, MaterialX and the web.

    Writes textures/*.exr and *.png (base_color, roughness, metallic, their standard deviations,
    packed orm, entropy, coverage), asset.glb, entropy.glb, object.xml, preview.xml, mesh.ply,
    material.mtlx, mesh.obj, and asset.json, which says what each file is.
    """

    result: Result
    """Folder that svu recover wrote."""
    command = "export"
    output: Output = Path("out/asset")
    entropy: Maps = None
    """Folder that svu entropy wrote about the same capture, for its maps; by default those in
    RESULT."""
    formats: Formats = ("exr", "png", "glb", "xml", "materialx")
    """What to write; xml includes exr, and materialx includes png."""
    bits: Literal[8, 16] = 8
    """Bits per channel of PNG."""
    half: bool = False
    """EXR in half precision."""
    gutter: Gutter = None
    """Width of the gutter around charts; by default everything between them is filled."""
    up: Literal["y", "z"] | None = None
    """Axis of the capture's world that points up; by default that of its cameras. glTF needs
    y, so a capture with z up is rotated in the GLB."""

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        self._options()

    def _options(self) -> ExportOptions:
        from svu_mi.output.export.write_asset import ExportOptions

        return ExportOptions(
            formats=self.formats, bits=self.bits, half=self.half, gutter=self.gutter, up=self.up
        )

    def work(self, progress: Progress, place: Claim) -> list[str]:
        """Read the result, and write the asset."""
        from svu_mi.output.export.load_asset import plan_asset
        from svu_mi.output.export.write_asset import export_asset

        with progress.stage("Reading the result"):
            plan = plan_asset(self.result, self.entropy)
            require_memory(progress, str(self.result), Need("export", Sizes(()), plan.size))
            asset = plan.read()
        with progress.stage("Writing the asset"):
            export_asset(asset, place, self._options())
        return []
