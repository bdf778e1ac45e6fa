"""Loading of a ``Capture`` from a scene file and a folder of photographs."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import mitsuba as mi

from svu_mi.capture import capture_folder
from svu_mi.capture.capture import Capture, LightUncertainty
from svu_mi.capture.capture_folder import Description
from svu_mi.capture.crop import WHOLE, Detail, Window
from svu_mi.capture.image_io import ImageFile
from svu_mi.capture.load_warnings import (
    RELATIVE_GAINS,
    check_photographs,
    unsupported,
    warn_of_back_faces,
)
from svu_mi.capture.match_photographs import Match, Missing, match_photographs, photographs_of
from svu_mi.capture.mesh import arrays, chart_coverage, has_uvs
from svu_mi.capture.mesh_scale import wrong_scale
from svu_mi.capture.photographs import open_photographs, read_photographs
from svu_mi.capture.pixel_buffer import room_for_photographs
from svu_mi.capture.scene import find_light, find_sensors, load_scene, require_variant
from svu_mi.capture.sensors import film_size
from svu_mi.capture.target import SceneTarget, find_target
from svu_mi.capture.unwrap import UNWRAPPED, unwrap_cached
from svu_mi.core.io.provenance import require_no_result
from svu_mi.core.memory import Size, Sizes
from svu_mi.core.validation import indices_of
from svu_mi.errors import CaptureError, SceneError, excerpt, warn

# Light beside exposures of EXIF, which have another unit.
UNKNOWN_LEVEL = LightUncertainty(scale=(0.7, 0.7, 0.7))
Light = Literal["required", "optional"]
Value = TypeVar("Value")


def load_capture(
    path: str | Path, images: str | Path | None = None, *, shape: str | None = None,
    defines: Mapping[str, str] | None = None, unwrap: bool = False, missing: Missing = "refuse",
    light: Light = "required", trust: bool = False, detail: Detail = WHOLE,
    memory: float | None = None, views: Iterable[int] | Iterable[bool] | None = None,
) -> Capture:  # fmt: skip
    """Load a scene and its photographs.

    Photographs are named ``view_0000.exr``, ... in the order of the sensors, or after the ids of
    the sensors. Files with other names are assigned in natural order, if there is one per sensor.
    8-bit textures of principled materials are stored as float32, so that gradients pass.

    Args:
        path: Path of a Mitsuba XML scene, or of a capture folder with a ``capture.json``.
        images: Folder of the photographs. Default: the capture folder, ``images`` next to the scene
            if it contains photographs, or the scene's folder. Sensors in its ``capture.json``
            replace the sensors of the scene.
        shape: Name of the target: an id, a file name if the shape has no id, the id of a BSDF, a
            number from 0 in the order of the scene, ``largest principled``, or several with commas
            between, which become one mesh with new UVs. Default: the only shape, or the only one
            with a principled BSDF.
        defines: Values of the scene's ``<default>`` parameters.
        unwrap: True computes new UVs even if the mesh has UVs. A mesh without UVs is always
            unwrapped, with a warning. The result is cached as ``unwrapped.ply`` in ``images``.
        missing: Treatment of sensors without a photograph: ``refuse`` raises an error,
            ``leave-out`` makes them unused views (see ``Candidates.without_photograph``).
        light: ``required`` raises an error if the scene has no light. ``optional`` accepts it,
            which is sufficient for ``svu_mi.check`` and ``svu_mi.estimate_light``.
        trust: True lets the scene load libraries as Mitsuba plugins, from folders ``plugins``
            next to it or in the working directory. Use it only for scenes of trusted authors.
        detail: Required resolution of photographs of 4 megapixels and more. For example,
            ``Detail(texels=(2048, 2048))`` crops them to the object and downsamples them to about
            one pixel per texel. By default they are kept unchanged.
        memory: Bytes of memory for photographs; default: half of the free memory. Larger captures
            are mapped from a temporary file in TMPDIR or /var/tmp.
        views: Indices of the photographs to read, or one flag per view; default: all. Other views
            are unused, and their pixels are NaN. An empty list loads only scene and sensors.

    Raises:
        OptionError: Invalid ``missing`` or ``light``, a path of the wrong type, or an unknown view.
        SvuEnvironmentError: No suitable Mitsuba variant is active.
        SceneError: The scene cannot be loaded or is incomplete.
        CaptureError: Photographs are missing, unreadable or of the wrong size.

    Example:
        >>> capture = svu.load_capture("capture")
        >>> capture.count, capture.images[0].shape
        (12, (96, 96, 3))
        >>> some = svu.load_capture("capture", views=[0, 3, 6])
        >>> sum(some.used)
        3
    """
    return plan_capture(
        path, images, shape=shape, defines=defines, unwrap=unwrap, missing=missing, light=light,
        trust=trust, detail=detail, views=views, float_textures=True,
    ).read(memory)  # fmt: skip


def plan_capture(
    path: str | Path, images: str | Path | None = None, *, shape: str | None = None,
    defines: Mapping[str, str] | None = None, trust: bool = False, missing: Missing = "refuse",
    light: Light = "required", float_textures: bool = False, **reading: Any,
) -> "CapturePlan":  # fmt: skip
    """Load a scene, match photographs with sensors, and read their headers.

    Arguments and errors: see ``load_capture``, and ``load_scene`` for ``float_textures``.
    """
    require_variant()
    path = Path(path)
    folder = Path(images) if images is not None else photographs_of(path)
    xml, remembered = _described(path, folder)
    description = dataclasses.replace(remembered.overridden(shape, defines), scene=xml)
    try:
        scene = load_scene(xml, description.defines, trust=trust, float_textures=float_textures)
    except SceneError as error:
        if xml == path or xml.is_relative_to(folder.resolve()):
            raise
        label = f"{folder / capture_folder.FILE}: its scene"
        raise SceneError(f"{label} {error}", shell=f"{label} {error.shell}") from error
    sensors = description.make_sensors(folder) or find_sensors(scene, str(xml))
    if images is None:
        folder = photographs_of(path, [sensor.id() for sensor in sensors])
    return plan_photographs(
        scene, sensors, folder, description, missing=missing, light=light, **reading
    )


def _described(path: Path, folder: Path) -> tuple[Path, Description]:
    """Return the scene's path, and the description in ``folder``."""
    description = capture_folder.read(folder) or Description()
    xml = path if path.suffix.lower() == ".xml" else description.scene
    if xml is None and path.is_dir():
        xml = (capture_folder.read(path) or Description()).scene
    if xml is None:
        require_no_result(path)
        raise CaptureError(
            f"{path}: neither a Mitsuba XML scene nor a capture folder with a scene; give the "
            "scene, and this folder with --images; captures of other tools need "
            "svu import first."
        )
    if xml != path and not xml.is_file():
        raise CaptureError(
            f"{folder / capture_folder.FILE}: its scene {excerpt(xml, 300)} does not exist; "
            "copy it there, or give the scene, and this folder with --images."
        )
    return xml, description


@dataclass(frozen=True, kw_only=True)
class CapturePlan:
    """A capture whose pixels are not read yet.

    Attributes:
        light: Environment emitter; None if the scene has no light.
        target: The object, and the scene that contains it as a mesh.
        sensors: V sensors whose films have the size of the files.
        folder: Folder of the photographs.
        description: Content of ``capture.json``.
        match: Files of the photographs.
        paths: V files to read; None for views that are missing or not requested.
        pictures: Image headers by view.
        windows: V crop windows.
        exposures: V exposure gains.
        unwrap: True computes new UVs.
        partial: True if only requested views are read.
    """

    light: Any
    target: SceneTarget
    sensors: Sequence[Any]
    folder: Path
    description: Description
    match: Match
    paths: Sequence[Path | None]
    pictures: Mapping[int, ImageFile]
    windows: Sequence[Window]
    exposures: Sequence[float]
    unwrap: bool
    partial: bool

    def sizes(self, memory: float | None = None) -> Sizes:
        """Return the sizes for memory estimates; ``memory`` as for ``read``."""
        return Sizes(
            [self.windows[view].size for view in self.pictures], map_size(self.light),
            1.0 if self.unwrap else chart_coverage(self.target.mesh), self.light is not None,
            stored=[picture.size for picture in self.pictures.values()],
            memory=self._room(memory), asked=memory is not None,
        )  # fmt: skip

    def _room(self, memory: float | None) -> float:
        if memory is not None:
            return memory
        return room_for_photographs([film_size(each) for each in self.sensors])

    def read(self, memory: float | None = None) -> Capture:
        """Read the photographs; above ``memory`` bytes they are mapped from a file."""
        photographs, buffer = read_photographs(
            self.pictures, self.windows, self.exposures, self._room(memory)
        )
        runs = {picture.path: photographs[k].run for k, picture in self.pictures.items()}
        capture_folder.require_one_run(self.folder, runs, self.description.run)
        names = self.match.names
        if len(self.description.photographs) == len(names):  # otherwise capture.json was edited
            names = [excerpt(name) for name in self.description.photographs]
        sensors = [w.seen_by(each) for w, each in zip(self.windows, self.sensors, strict=True)]
        notes, used = check_photographs(photographs, self.paths, names, some=self.partial)
        mesh, unwrapping = _texel_mesh(self.target, self.unwrap, self.folder)
        target = self.target
        own = mesh is target.mesh and len(target.materials) == 1
        material = unsupported(target.scene, target.mesh, target.materials, own_uvs=own)
        notes = [*self.match.notes, *notes, *unwrapping, *material]
        notes += self._geometry_warnings(sensors)
        relative = bool(self.description.imported.get("relative_gains"))
        notes += [RELATIVE_GAINS] * (relative and self.light is not None)
        for sentence in notes:
            warn(sentence)
        return Capture(
            scene=target.scene, shape=target.mesh, mesh=mesh, sensors=tuple(sensors),
            images=tuple(photograph.pixels for photograph in photographs),
            masks=tuple(photograph.mask for photograph in photographs),
            exposures=tuple(self.exposures),
            exposures_known=bool(self.description.exposures) or not self.description.imported,
            names=tuple(names), files=tuple(self.match.names),
            unusable=tuple(p.invalid + p.marked + p.saturated for p in photographs),
            used=used, source=self.folder, warnings=tuple(notes),
            clipped=_any(photograph.clipped for photograph in photographs),
            rounding=_any(photograph.rounding for photograph in photographs), buffer=buffer,
            flash=self.description.flash,
            exposures_relative=relative,
            light_uncertainty=UNKNOWN_LEVEL if relative and self.light is not None else None,
        )  # fmt: skip

    def _geometry_warnings(self, sensors: Sequence[Any]) -> list[str]:
        """Return a warning if the unit of the mesh, or its front side, seems to be wrong."""
        wrong = wrong_scale(arrays(self.target.mesh).positions, self.sensors)
        if wrong is None:
            return warn_of_back_faces(self.target.scene, self.target.mesh, sensors)
        return [f"Shape '{self.target.mesh.id()}': {wrong.sentence(self.description.mesh_scale)}"]


def plan_photographs(
    scene: Any, sensors: Sequence[Any], folder: Path, description: Description, *,
    unwrap: bool = False, missing: Missing = "refuse", light: Light = "required",
    detail: Detail = WHOLE, views: Iterable[int] | None = None,
) -> CapturePlan:  # fmt: skip
    """Match photographs with sensors of a loaded scene (``plan_capture``)."""
    label = str(description.scene or folder)
    environment = _light(scene, description, light, folder)
    target = find_target(scene, description.shape, label)
    # Other images in the scene's folder may be textures.
    own = description.scene is None or description.scene.resolve().parent != folder.resolve()
    match = match_photographs(folder, [s.id() for s in sensors], missing, any_name=own)
    paths = _chosen(match.paths, views)
    exposures = _exposures(description.exposures, len(sensors), folder)
    films = [film_size(sensor) for sensor in sensors]
    seen = detail.windows(target.mesh, sensors)
    windows = [
        Window.whole(film) if path is None else window
        for film, path, window in zip(films, paths, seen, strict=True)
    ]
    return CapturePlan(
        light=environment, target=target, sensors=sensors, folder=folder,
        description=description, match=match, paths=paths,
        pictures=open_photographs(paths, films), windows=windows, exposures=exposures,
        unwrap=unwrap, partial=views is not None,
    )  # fmt: skip


def _any(values: Iterable[Value | None]) -> tuple[Value | None, ...]:
    """Return the values as a tuple; empty without any value."""
    known = tuple(values)
    return known if any(each is not None for each in known) else ()


def _exposures(given: Sequence[float], count: int, folder: Path) -> list[float]:
    file = folder / capture_folder.FILE
    if given and len(given) != count:
        raise CaptureError(f"{file}: {len(given)} exposures for {count} views; give one per view.")
    return [float(gain) for gain in given] or [1.0] * count


def _light(scene: Any, description: Description, light: Light, folder: Path) -> Any:
    """Return the environment emitter; None without light if ``light`` allows that."""
    if not scene.emitters():
        if light == "optional" or description.flash is not None:
            return None
        if description.imported:
            raise SceneError(
                f'{folder}: was imported without a light; load it with light="optional" and add '
                "svu.with_light(capture, light): light from svu.load_light() of a folder of svu "
                "light, or from svu.estimate_light(capture, texels). Or import it again with "
                "--environment and the environment map of the photographs.",
                shell=f"{folder}: was imported without a light; estimate it with svu light, or "
                "import it again with --environment and the environment map of the photographs.",
            )
    return find_light(scene, str(description.scene or folder))


def map_size(light: Any) -> Size:
    """Return (width, height) of an environment map; (0, 0) for other emitters."""
    if light is None or light.class_name() != "EnvironmentMapEmitter":
        return 0, 0
    height, width = mi.traverse(light)["data"].shape[:2]
    return width - 2, height  # without the halo column on each side


def _chosen(paths: Sequence[Path | None], views: Iterable[int] | None) -> list[Path | None]:
    """Return the files of the requested views; None for the others."""
    if views is None:
        return list(paths)
    chosen = set(indices_of(list(views), len(paths), "load_capture()", "view").tolist())
    return [path if view in chosen else None for view, path in enumerate(paths)]


def _texel_mesh(target: SceneTarget, unwrap: bool, folder: Path) -> tuple[Any, list[str]]:
    mesh = target.mesh
    if has_uvs(mesh) and not unwrap:
        return mesh, []
    reason = "is unwrapped again, as requested" if has_uvs(mesh) else target.lack
    where = f"UVs are laid out by xatlas; they are kept in {folder / UNWRAPPED}."
    return unwrap_cached(mesh, folder), [f"Shape '{mesh.id()}' {reason}: {where}"]
