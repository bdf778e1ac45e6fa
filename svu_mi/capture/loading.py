"""From a scene file and a folder of photographs to a ``Capture``."""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import mitsuba as mi

from svu_mi.capture import capture_folder
from svu_mi.capture.capture import Capture
from svu_mi.capture.capture_folder import Description
from svu_mi.capture.crop import WHOLE, Detail, Window
from svu_mi.capture.image_io import ImageFile
from svu_mi.capture.load_warnings import check_photographs, unsupported, warn_of_back_faces
from svu_mi.capture.match_photographs import Match, Missing, match_photographs, photographs_of
from svu_mi.capture.mesh import chart_coverage, has_uvs
from svu_mi.capture.photographs import open_photographs, read_photographs
from svu_mi.capture.pixel_buffer import room_for_photographs
from svu_mi.capture.scene import (
    find_environment,
    find_sensors,
    find_shape,
    load_scene,
    require_variant,
)
from svu_mi.capture.sensors import LARGEST, film_size
from svu_mi.capture.unwrap import UNWRAPPED, unwrap_cached
from svu_mi.core.io.provenance import require_no_result
from svu_mi.core.memory import Size, Sizes
from svu_mi.errors import CaptureError, OptionError, SceneError, SvuWarning, excerpt

Light = Literal["required", "optional"]
Value = TypeVar("Value")


def load_capture(
    path: str | Path,
    images: str | Path | None = None,
    *,
    shape: str | None = None,
    defines: Mapping[str, str] | None = None,
    unwrap: bool = False,
    missing: Missing = "refuse",
    light: Light = "required",
    trust: bool = False,
    detail: Detail = WHOLE,
    memory: float | None = None,
    views: Iterable[int] | None = None,
) -> Capture:
    """Read a scene and its photographs.

    Args:
        path: a Mitsuba XML scene, or a capture folder (with ``capture.json``).
        images: folder with the photographs: ``view_0000.exr``, ... in the order of the sensors, or
            of the sensors' ids, or as many as there are sensors, in the natural order of their
            names, which is said. By default the capture folder, the scene's folder, or ``images``
            beside the scene if names there say that these are photographs. If it has a
            ``capture.json`` with sensors, those are the photographs' poses.
        shape: id of the target; by default the only mesh (with a principled BSDF).
        defines: values for the scene's ``<default>`` parameters.
        unwrap: lay out new UVs even if the mesh has some. A mesh without UVs is unwrapped
            anyway, with a warning; the result is kept as ``unwrapped.ply`` with the images.
        missing: what to do with sensors that have no photograph: ``refuse``, or ``leave-out``
            (they become views that are not used, of NaN that takes no memory, so that
            ``Candidates.without_photograph`` finds them).
        light: whether the scene must have one: ``required``, or ``optional`` for what can do
            without, such as ``svu_mi.check`` and ``svu_mi.estimate_light``;
            ``Capture.environment`` may be None then.
        trust: let the scene load libraries as Mitsuba plugins, from ``plugins`` beside it or in
            the working directory; only for scenes of people you know. A library never replaces
            a plugin of Mitsuba's own.
        detail: what is needed of photographs of 4 megapixels and more: those of
            ``Detail(texels=(2048, 2048))`` are cropped to the object, and made smaller as far as
            texels keep about one pixel across. By default they are kept as they are.
        memory: bytes that photographs may take, by default half of what is free. Beyond that they
            lie in a file, in TMPDIR or /var/tmp, which ends with the process.
        views: numbers of the photographs to read, by default all. Others are views that are not
            used, of NaN that takes no memory; none at all reads the scene and the poses.

    Raises:
        OptionError: another word for ``missing`` or ``light``, a path that is none, or a view that
            there is not.
        SvuEnvironmentError: no suitable Mitsuba variant is active.
        SceneError: the scene cannot be loaded or lacks something.
        CaptureError: photographs are missing, unreadable or do not fit.
    """
    return plan_capture(
        path, images, shape=shape, defines=defines, unwrap=unwrap, missing=missing, light=light,
        trust=trust, detail=detail, views=views,
    ).read(memory)  # fmt: skip


def plan_capture(
    path: str | Path,
    images: str | Path | None = None,
    *,
    shape: str | None = None,
    defines: Mapping[str, str] | None = None,
    trust: bool = False,
    missing: Missing = "refuse",
    light: Light = "required",
    **reading: Any,
) -> CapturePlan:
    """Load a scene, match photographs with its sensors, and read their headers, but no pixel.

    Arguments and errors are those of ``load_capture``.
    """
    require_variant()
    if not isinstance(path, str | os.PathLike):
        raise OptionError(
            f"load_capture(): the path of a scene or a capture is needed, got a "
            f"{type(path).__name__}."
        )
    for name, word, known in (("missing", missing, Missing), ("light", light, Light)):
        if word not in get_args(known):
            raise OptionError(
                f"load_capture(): {name} must be one of {', '.join(map(repr, get_args(known)))}, "
                f"got {word!r}."
            )
    path = Path(path)
    folder = Path(images) if images is not None else photographs_of(path)
    xml, remembered = _described(path, folder)
    description = dataclasses.replace(  # what the caller says wins
        remembered, scene=xml, shape=shape or remembered.shape,
        defines={**remembered.defines, **(defines or {})},
    )  # fmt: skip
    scene = load_scene(xml, description.defines, trust=trust)
    sensors = description.make_sensors(folder) or find_sensors(scene, str(xml))
    if images is None:
        folder = photographs_of(path, [sensor.id() for sensor in sensors])
    return plan_photographs(
        scene, sensors, folder, description, missing=missing, light=light, **reading
    )


def _described(path: Path, folder: Path) -> tuple[Path, Description]:
    """Return the scene that is meant, and what a folder of photographs says of itself."""
    description = capture_folder.read(folder) or Description()
    xml = path if path.suffix.lower() == ".xml" else description.scene
    if xml is None and path.is_dir():
        xml = (capture_folder.read(path) or Description()).scene
    if xml is None:
        require_no_result(path)
        raise CaptureError(
            f"{path}: neither a Mitsuba XML scene nor a capture folder that names one; give the "
            "scene, and this folder as --images."
        )
    if xml != path and not xml.is_file():
        raise CaptureError(
            f"{folder / capture_folder.FILE}: its scene {excerpt(xml, 300)} does not exist; "
            "copy it there, or give the scene, and this folder as --images."
        )
    return xml, description


@dataclass(frozen=True, kw_only=True)
class CapturePlan:
    """A capture of which no pixel was read yet.

    Attributes:
        scene: the ``mi.Scene``.
        light: its environment emitter; None without one.
        target: the object.
        sensors: V sensors, with the films of whole photographs.
        folder: of the photographs.
        description: of the capture.
        match: the files of the photographs.
        paths: V files to read; None for views without one, and for those not asked for.
        pictures: their headers, by view.
        windows: what is kept of each photograph.
        exposures: V gains.
        unwrap: whether to lay out new UVs.
        partial: whether only some views are read.
    """

    scene: Any
    light: Any
    target: Any
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
        """Return how large everything is, with photographs in ``memory`` bytes (``read``)."""
        return Sizes(
            [self.windows[view].size for view in self.pictures], map_size(self.light),
            1.0 if self.unwrap else chart_coverage(self.target), self.light is not None,
            stored=[picture.size for picture in self.pictures.values()],
            memory=self._room(memory), asked=memory is not None,
        )  # fmt: skip

    def _room(self, memory: float | None) -> float:
        if memory is not None:
            return memory
        return room_for_photographs([film_size(each) for each in self.sensors])

    def read(self, memory: float | None = None) -> Capture:
        """Read the photographs."""
        photographs, buffer = read_photographs(
            self.pictures, self.windows, self.exposures, self._room(memory)
        )
        runs = {picture.path: photographs[k].run for k, picture in self.pictures.items()}
        capture_folder.require_one_run(self.folder, runs, self.description.run)
        names = self.match.names
        if len(self.description.photographs) == len(names):  # else capture.json was edited
            names = [excerpt(name) for name in self.description.photographs]
        sensors = [w.seen_by(each) for w, each in zip(self.windows, self.sensors, strict=True)]
        notes, used = check_photographs(photographs, self.paths, names, some=self.partial)
        mesh, unwrapping = _texel_mesh(self.target, self.unwrap, self.folder)
        notes = [*self.match.notes, *notes, *unwrapping, *unsupported(self.scene, self.target)]
        notes += warn_of_back_faces(self.scene, self.target, sensors)
        for sentence in notes:
            warnings.warn(sentence, SvuWarning, stacklevel=3)
        return Capture(
            scene=self.scene, shape=self.target, mesh=mesh, sensors=tuple(sensors),
            images=tuple(photograph.pixels for photograph in photographs),
            masks=tuple(photograph.mask for photograph in photographs),
            exposures=tuple(self.exposures), names=tuple(names), files=tuple(self.match.names),
            unusable=tuple(p.invalid + p.marked + p.saturated for p in photographs),
            used=used, source=self.folder, warnings=tuple(notes),
            clipped=_any(photograph.clipped for photograph in photographs),
            rounding=_any(photograph.rounding for photograph in photographs), buffer=buffer,
        )  # fmt: skip


def plan_photographs(
    scene: Any,
    sensors: Sequence[Any],
    folder: Path,
    description: Description,
    *,
    unwrap: bool = False,
    missing: Missing = "refuse",
    light: Light = "required",
    detail: Detail = WHOLE,
    views: Iterable[int] | None = None,
) -> CapturePlan:
    """Match the photographs of a folder with sensors of a live scene (see ``plan_capture``)."""
    label = str(description.scene or folder)
    environment = _light(scene, description, light, folder)
    target = find_shape(scene, description.shape, label)
    # Beside a scene's file, not every picture is a photograph.
    own = description.scene is None or description.scene.resolve().parent != folder.resolve()
    match = match_photographs(folder, [s.id() for s in sensors], missing, any_name=own)
    paths = _chosen(match.paths, views)
    exposures = _exposures(description.exposures, len(sensors), folder)
    films = [film_size(sensor) for sensor in sensors]
    windows = [
        Window.whole(film) if path is None else window
        for film, path, window in zip(films, paths, detail.windows(target, sensors), strict=True)
    ]
    return CapturePlan(
        scene=scene, light=environment, target=target, sensors=sensors, folder=folder,
        description=description, match=match, paths=paths,
        pictures=open_photographs(paths, films), windows=windows, exposures=exposures,
        unwrap=unwrap, partial=views is not None,
    )  # fmt: skip


def _any(values: Iterable[Value | None]) -> tuple[Value | None, ...]:
    """Return what is known of each photograph; nothing if it is of none."""
    known = tuple(values)
    return known if any(each is not None for each in known) else ()


def _exposures(given: Sequence[float], count: int, folder: Path) -> list[float]:
    file = folder / capture_folder.FILE
    if given and len(given) != count:
        raise CaptureError(f"{file}: {len(given)} exposures for {count} views; give one per view.")
    for index, gain in enumerate(given):
        if not 1 / LARGEST <= gain <= LARGEST:  # NaN fails, too; pixels are divided by it
            raise CaptureError(
                f"{file}: the exposure of view {index} is {excerpt(gain, 40)}; it must be in "
                f"[{1 / LARGEST:g}, {LARGEST:g}]."
            )
    return [float(gain) for gain in given] or [1.0] * count


def _light(scene: Any, description: Description, light: Light, folder: Path) -> Any:
    """Return the light; None without one, where that is optional."""
    if not scene.emitters():
        if light == "optional":
            return None
        if description.imported:
            raise SceneError(
                f'{folder}: was imported without a light; load it with light="optional", and '
                "find one with svu.estimate_light(capture, texels), or import it again with "
                "--environment, the map of the light that the photographs were taken under.",
                shell=f"{folder}: was imported without a light; find it in the photographs with "
                "svu light, or import it again with --environment, the map of the light that they "
                "were taken under.",
            )
    return find_environment(scene, str(description.scene or folder))


def map_size(light: Any) -> Size:
    """Return (width, height) of an environment map; (0, 0) of any other light, or None."""
    if light is None or light.class_name() != "EnvironmentMapEmitter":
        return 0, 0
    height, width = mi.traverse(light)["data"].shape[:2]
    return width - 2, height  # a column on each side is the other end's


def _chosen(paths: Sequence[Path | None], views: Iterable[int] | None) -> list[Path | None]:
    """Return the files of the views that are to be read; None for all others."""
    count = len(paths)
    chosen = frozenset(range(count) if views is None else views)
    for view in sorted(chosen - set(range(count))):
        raise OptionError(f"load_capture(): there is no view {view}; there are {count}, from 0 on.")
    return [path if view in chosen else None for view, path in enumerate(paths)]


def _texel_mesh(shape: Any, unwrap: bool, folder: Path) -> tuple[Any, list[str]]:
    if has_uvs(shape) and not unwrap:
        return shape, []
    reason = "is unwrapped again, as requested" if has_uvs(shape) else "has no UVs"
    where = f"UVs are laid out by xatlas; they are kept in {folder / UNWRAPPED}."
    return unwrap_cached(shape, folder), [f"Shape '{shape.id()}' {reason}: {where}"]
