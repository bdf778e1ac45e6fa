"""From a scene file and a folder of photographs to a ``Capture``."""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import mitsuba as mi

from svu_mi.capture import folder as capture_folder
from svu_mi.capture.block import room_for_photographs
from svu_mi.capture.folder import Description
from svu_mi.capture.ignored import ignored
from svu_mi.capture.images import read_photographs
from svu_mi.capture.judging import judged
from svu_mi.capture.matching import Match, Missing, match_photographs, photographs_of
from svu_mi.capture.mesh import covered_by_charts, has_uvs
from svu_mi.capture.poses import film_size
from svu_mi.capture.record import Capture, Recipe
from svu_mi.capture.scene import (
    find_environment,
    find_sensors,
    find_shape,
    load_scene,
    require_variant,
)
from svu_mi.capture.sensor_record import LARGEST
from svu_mi.capture.unwrap import UNWRAPPED, unwrapped
from svu_mi.capture.winding import seen_from_behind
from svu_mi.capture.window import WHOLE, Detail
from svu_mi.errors import CaptureError, OptionError, SceneError, SvuWarning, excerpt
from svu_mi.needs import Size, Sizes
from svu_mi.results.reading import require_no_result

Light = Literal["required", "optional"]
Preflight = Callable[[Sizes], float | None]
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
    preflight: Preflight | None = None,
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
        preflight: called before any pixel is read with how large everything is; it may refuse, and
            may return another ``memory``.
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
    require_variant()
    if not isinstance(path, str | os.PathLike):
        raise OptionError(
            f"load_capture(): the path of a scene or a capture is needed, got a "
            f"{type(path).__name__}."
        )
    reading = Reading(
        unwrap=unwrap, missing=missing, light=light, preflight=preflight, detail=detail,
        memory=memory, views=None if views is None else frozenset(views),
    )  # fmt: skip
    recipe = Recipe(
        path=path, images=images, shape=shape, defines=tuple((defines or {}).items()),
        unwrap=unwrap, missing=missing, trust=trust, detail=detail,
    )  # fmt: skip
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
    found = read_capture(scene, sensors, folder, description, reading)
    return dataclasses.replace(found, recipe=recipe)


def _described(path: Path, folder: Path) -> tuple[Path, Description]:
    """Return the scene that is meant, and what a folder of photographs says of itself.

    Raises:
        CaptureError: there is no scene.
    """
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
class Reading:
    """How a capture is read; see ``load_capture``."""

    unwrap: bool = False
    missing: Missing = "refuse"
    light: Light = "required"
    preflight: Preflight | None = None
    detail: Detail = WHOLE
    memory: float | None = None
    views: frozenset[int] | None = None

    def __post_init__(self) -> None:
        words = {"missing": get_args(Missing), "light": get_args(Light)}
        for name, known in words.items():
            if getattr(self, name) not in known:
                raise OptionError(
                    f"load_capture(): {name} must be one of {', '.join(map(repr, known))}, "
                    f"got {getattr(self, name)!r}."
                )


def read_capture(
    scene: Any,
    sensors: Sequence[Any],
    folder: Path,
    description: Description,
    reading: Reading | None = None,
) -> Capture:
    """Read the photographs of a folder for a live scene (see ``load_capture``)."""
    reading = reading or Reading()
    label = str(description.scene or folder)
    light = _light(scene, description, reading, folder)
    target = find_shape(scene, description.shape, label)
    found = _match(sensors, folder, description, reading)
    paths = _chosen(found.paths, reading.views)
    exposures = _exposures(description.exposures, len(sensors), folder)
    windows = reading.detail.windows(target, sensors)
    films = [film_size(sensor) for sensor in sensors]
    memory = room_for_photographs(films) if reading.memory is None else reading.memory

    def opened(taken: Sequence[int]) -> float | None:
        if reading.preflight is None:
            return None
        charts = 1.0 if reading.unwrap else covered_by_charts(target)
        return reading.preflight(Sizes(
            [windows[view].size for view in taken], map_size(light), charts, light is not None,
            stored=[films[view] for view in taken], memory=memory,
            asked=reading.memory is not None,
        ))  # fmt: skip

    photographs = read_photographs(
        paths, windows, exposures, films=films, memory=memory, opened=opened
    )
    sensors = [
        sensor if path is None else window.seen_by(sensor)
        for sensor, window, path in zip(sensors, windows, paths, strict=True)
    ]
    runs = {p: each.run for p, each in zip(paths, photographs, strict=True) if p is not None}
    capture_folder.require_one_run(folder, runs, description.run)
    names = found.names
    if len(description.photographs) == len(names):  # else somebody has changed capture.json
        names = [excerpt(name) for name in description.photographs]
    notes, used = judged(photographs, paths, names, some=reading.views is not None)
    mesh, note = _texel_mesh(target, reading.unwrap, folder)
    notes = [*found.notes, *notes, *note, *ignored(scene, target)]
    notes += seen_from_behind(scene, target, sensors)
    for sentence in notes:
        warnings.warn(sentence, SvuWarning, stacklevel=3)
    return Capture(
        scene=scene,
        shape=target,
        mesh=mesh,
        sensors=tuple(sensors),
        images=tuple(photograph.pixels for photograph in photographs),
        masks=tuple(photograph.mask for photograph in photographs),
        exposures=tuple(exposures),
        names=tuple(names),
        files=tuple(found.names),
        unusable=tuple(p.invalid + p.marked + p.saturated for p in photographs),
        used=used,
        source=folder,
        warnings=tuple(notes),
        clipped=_any(photograph.clipped for photograph in photographs),
        rounding=_any(photograph.rounding for photograph in photographs),
    )


def _any(values: Iterable[Value | None]) -> tuple[Value | None, ...]:
    """Return what is known of each photograph; nothing if it is of none."""
    found = tuple(values)
    return found if any(each is not None for each in found) else ()


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


def _light(scene: Any, description: Description, reading: Reading, folder: Path) -> Any:
    """Return the light; None without one, where that is optional."""
    if not scene.emitters():
        if reading.light == "optional":
            return None
        if description.imported:
            raise SceneError(
                f"{folder}: was imported without a light; load it with light=\"optional\", and "
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


def _match(
    sensors: Sequence[Any], folder: Path, description: Description, reading: Reading
) -> Match:
    """Find the photographs; beside a scene's file, not every picture is one."""
    scene = description.scene
    own = scene is None or scene.resolve().parent != folder.resolve()
    ids = [sensor.id() for sensor in sensors]
    return match_photographs(folder, ids, reading.missing, any_name=own)


def _chosen(paths: Sequence[Path | None], views: frozenset[int] | None) -> list[Path | None]:
    """Return the files of the views that are to be read; None for all others."""
    if views is None:
        return list(paths)
    for view in sorted(views):
        if not 0 <= view < len(paths):
            raise OptionError(
                f"load_capture(): there is no view {view}; there are {len(paths)}, from 0 on."
            )
    return [path if view in views else None for view, path in enumerate(paths)]


def _texel_mesh(shape: Any, unwrap: bool, folder: Path | None) -> tuple[Any, list[str]]:
    if has_uvs(shape) and not unwrap:
        return shape, []
    reason = "has no UVs" if not has_uvs(shape) else "is unwrapped again, as requested"
    kept = "" if folder is None else f"; they are kept in {folder / UNWRAPPED}"
    note = f"Shape '{shape.id()}' {reason}: UVs are laid out by xatlas{kept}."
    return unwrapped(shape, folder), [note]
