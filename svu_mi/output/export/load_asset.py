"""Asset from the folders of ``svu recover`` and ``svu entropy``."""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from svu_mi.capture.mesh import MeshArrays, read_ply
from svu_mi.capture.plugin_security import pin_own_plugins
from svu_mi.capture.up_direction import up_of_poses
from svu_mi.core.io.exr import read_exr, read_header
from svu_mi.core.io.files import refusing
from svu_mi.core.io.folder_exchange import restore
from svu_mi.core.io.provenance import (
    are_of_one_capture,
    marks_of,
    require_one_run,
    require_recovery,
)
from svu_mi.core.io.schema import LARGEST, Axis, Field, checked
from svu_mi.core.memory import Size
from svu_mi.errors import CaptureError, MeshError, warn
from svu_mi.output.export.asset import Asset, usable_normals
from svu_mi.output.maps import COVERAGE, ENTROPY, UNCERTAINTY, read_deviations, read_map
from svu_mi.output.object_views import named_up
from svu_mi.output.run_record import RECORD
from svu_mi.output.texture_files import FILES, MESH, NORMALS, SCENE, read_textures

HEADER = 4096  # largest size of a PLY header in bytes
PART = Field("f", (Axis("rows", 1), Axis("columns", 1)), 0, 1, default=None)
PIXELS = Field("f", PART.shape, -LARGEST, LARGEST)
VIEWS = PART._replace(high=LARGEST)


def load_asset(folder: str | Path, entropy: str | Path | None = None) -> Asset:
    """Read an asset from a folder that ``svu recover`` wrote.

    Args:
        folder: Folder with ``base_color.exr``, ``roughness.exr``, ``metallic.exr``,
            ``recovered.xml`` and ``assets/mesh.ply``. ``coverage.exr``, ``entropy.exr`` and the
            standard deviations of ``uncertainty.exr`` are optional.
        entropy: Folder of ``svu entropy`` for the same capture; replaces the maps of entropy and
            coverage, and may have another resolution.

    Raises:
        CaptureError: a file is missing or damaged, or belongs to another run, mesh or capture.
        MeshError: the mesh cannot be read, or has no UVs.

    Example:
        >>> from svu_mi.output.write_recovery import write_recovery
        >>> write_recovery(capture, recovery, "result", pictures=False)
        >>> svu.load_asset("result").textures.resolution
        (64, 64)
    """
    return plan_asset(Path(folder), None if entropy is None else Path(entropy)).read()


@dataclass(frozen=True)
class AssetPlan:
    """Checked folders of a recovery and its maps, before reading."""

    folder: Path
    maps: Path

    @property
    def size(self) -> Size:
        """(Width, height) of the largest texture or map."""
        files = [self.folder / FILES["base_color"], self.maps / ENTROPY, self.maps / COVERAGE]
        sizes = [read_header(path).size for path in files if path.is_file()]
        return max(sizes, key=lambda size: size[0] * size[1])

    def read(self) -> Asset:
        """Read all files (see ``load_asset``)."""
        folder, maps = self.folder, self.maps
        file = folder / SCENE
        try:
            scene = ElementTree.parse(file).getroot()
        except (OSError, ElementTree.ParseError) as error:
            raise CaptureError(
                f"{file}: cannot be read ({error}); run svu recover again."
            ) from error
        shape = _object_node(scene, file)
        smooth = shape.find("boolean[@name='face_normals']") is None
        mesh, normals = _read_mesh(folder / MESH, smooth), None
        if shape.find(".//bsdf[@type='normalmap']") is not None:
            normals = usable_normals(_read_normals(folder / NORMALS), mesh)
        if normals is None and shape.find(".//texture[@name='normalmap']") is not None:
            sentence = (
                f"{file}: the object's bump map, or normal map on mirrored UVs, is not exported; "
                "bake it there."
            )
            warn(sentence)
        textured = folder / FILES["base_color"]
        return Asset(
            name=shape.get("id") or "object",
            mesh=mesh,
            textures=read_textures(folder),
            entropy=_read_map(maps / ENTROPY, PART),
            coverage=_read_map(maps / COVERAGE, VIEWS),
            deviations=_read_deviations(folder / UNCERTAINTY, textured),
            normals=normals,
            two_sided=shape.find("bsdf[@type='twosided']") is not None,
            up=named_up(up_of_poses(_camera_poses(scene))),
            source=str(folder),
            capture=marks_of(textured)[1],
        )


def plan_asset(folder: Path, entropy: Path | None) -> AssetPlan:
    """Locate the files of an asset, and check that they come from one run and capture."""
    restore(folder)
    require_recovery(folder, [*FILES.values(), SCENE, MESH], RECORD, ENTROPY)
    require_one_run(folder, [*FILES.values(), SCENE, MESH], RECORD, "recover")
    maps = entropy or folder
    if entropy is not None:
        restore(maps)
        if not (maps / ENTROPY).is_file():
            raise CaptureError(f"{maps}: has no {ENTROPY}; give the folder that svu entropy wrote.")
    _require_same_capture(maps, folder / FILES["base_color"], explicit=entropy is not None)
    return AssetPlan(folder, maps)


def _require_same_capture(folder: Path, textured: Path, *, explicit: bool) -> None:
    """Check the run and capture of maps; another capture only warns if ``explicit``."""
    maps = [name for name in (ENTROPY, COVERAGE) if (folder / name).is_file()]
    runs = {marks_of(folder / name)[0] for name in maps}
    if len(runs - {""}) > 1:
        raise CaptureError(
            f"{folder}: {ENTROPY} and {COVERAGE} come from different runs; run svu entropy again."
        )
    for path in (folder / name for name in maps):
        if are_of_one_capture(textured, path):
            continue
        sentence = f"{path}: comes from another capture than {textured}"
        if not explicit:
            raise CaptureError(
                f"{sentence}; compute both from one capture, or give the folder of the maps with "
                "--entropy."
            )
        warn(f"{sentence}; its values are used as they are.")
        return


def _object_node(scene: ElementTree.Element, path: Path) -> ElementTree.Element:
    """Return the XML node of the object."""
    for shape in scene.findall("shape"):
        if shape.find(f"string[@value='{MESH}']") is not None:
            return shape
    raise CaptureError(f"{path}: no shape has the mesh {MESH}; run svu recover again.")


def _camera_poses(scene: ElementTree.Element) -> np.ndarray:
    """Return the camera poses (V, 4, 4) of a scene; cameras without a matrix are skipped."""
    rows = [matrix.get("value", "").split() for matrix in scene.findall("sensor/transform/matrix")]
    try:
        return np.array([row for row in rows if len(row) == 16], np.float64).reshape(-1, 4, 4)
    except ValueError:
        return np.zeros((0, 4, 4))


def _read_mesh(path: Path, smooth: bool) -> MeshArrays:
    with path.open("rb") as stream:
        header = stream.read(HEADER).partition(b"end_header")[0]
    if smooth and b" nx\n" not in header.replace(b"\r", b""):
        raise MeshError(f"{path}: has no vertex normals (nx, ny, nz); run svu recover again.")
    pin_own_plugins()
    return read_ply(path, smooth=smooth)


def _read_deviations(path: Path, textured: Path) -> dict[str, np.ndarray]:
    """Return standard deviations (H, W) by parameter (for colours, the maximum over channels);
    empty if the file is missing or comes from another run than the textures."""
    if not path.is_file() or marks_of(path)[0] != marks_of(textured)[0]:
        return {}
    deviations = {name: sd.max(axis=2) for name, sd in read_deviations(path.parent).items()}
    with refusing(path, "compute the file again"):
        return checked(deviations, dict.fromkeys(deviations, PART))


def _read_normals(path: Path) -> np.ndarray:
    with refusing(path, "recover it again"):
        planes = checked(read_exr(path), dict.fromkeys("RGB", PIXELS))
    return np.stack([planes[name] for name in "RGB"], axis=2)


def _read_map(path: Path, field: Field) -> np.ndarray | None:
    """Return an (H, W) map; None if the file is missing."""
    with refusing(path, "compute the file again"):
        return checked({"Y": read_map(path)}, {"Y": field})["Y"]  # type: ignore[no-any-return]
