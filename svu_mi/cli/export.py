"""``svu export``: export of recovered textures to other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from svu_mi.cli.base_command import ResultCommand
from svu_mi.cli.loading import require_memory
from svu_mi.cli.shared_options import Output
from svu_mi.core.io.output_folder import Claim
from svu_mi.core.memory import Need, Sizes
from svu_mi.core.progress import Progress

if TYPE_CHECKING:
    from svu_mi.output.export.write_asset import ExportOptions

Result = Annotated[Path, Positional, arg(metavar="RESULT")]
Format = Literal["exr", "png", "glb", "xml", "materialx"]
Formats = Annotated[tuple[Format, ...], arg(metavar="{exr,png,glb,xml,materialx} ...")]
Maps = Annotated[Path | None, arg(metavar="FOLDER")]
Gutter = Annotated[int | None, arg(metavar="TEXELS", help_behavior_hint="")]


@dataclass(frozen=True, kw_only=True)
class Export(ResultCommand):
    """Export recovered textures to Blender, Mitsuba, MaterialX and the web.

    Writes textures/*.exr and *.png (base_color, roughness, metallic, their standard deviations,
    packed orm, entropy, coverage), asset.glb, entropy.glb, object.xml, preview.xml, mesh.ply,
    material.mtlx, mesh.obj, and asset.json, which describes each file.
    """

    result: Result
    """Folder written by svu recover."""
    command = "export"
    first = "result output formats up entropy bits half gutter overwrite"
    output: Output = Path("out/asset")
    entropy: Maps = None
    """Folder written by svu entropy for the same capture, whose maps are exported (default: those
    in RESULT)."""
    formats: Formats = ("exr", "png", "glb", "xml", "materialx")
    """Formats to write, such as glb for the web; xml includes exr, materialx includes png."""
    bits: Literal[8, 16] = 8
    """Bits per channel of PNG files; 16 avoid banding."""
    half: bool = False
    """Write EXR in half precision, which halves the size of files."""
    gutter: Gutter = None
    """Texels to extend UV charts by (default: fill all texels between charts)."""
    up: Literal["y", "z"] | None = None
    """Up axis of the capture; in GLB files, z is rotated to +Y (default: inferred from the
    cameras)."""

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        self._options()

    def _options(self) -> "ExportOptions":
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
