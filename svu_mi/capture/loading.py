"""From a scene file and a folder of photographs to a ``Capture``."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from svu_mi.capture import folder as capture_folder
from svu_mi.capture.folder import Description
from svu_mi.capture.images import Missing, Photograph, find_images, read_photographs
from svu_mi.capture.mesh import has_uvs
from svu_mi.capture.poses import film_size
from svu_mi.capture.record import Capture
from svu_mi.capture.scene import (
    find_environment,
    find_sensors,
    find_shape,
    load_scene,
    require_variant,
)
from svu_mi.capture.sensor_record import LARGEST
from svu_mi.capture.unwrap import UNWRAPPED, unwrapped
from svu_mi.errors import CaptureError, OptionError, SvuWarning, excerpt

NOT_HDR = {
    8: "an 8-bit image, not HDR; decoded as sRGB, ",
    16: "a 16-bit image, not HDR; decoded as sRGB, ",
}


def load_capture(
    path: str | Path,
    images: str | Path | None = None,
    *,
    shape: str | None = None,
    defines: Mapping[str, str] | None = None,
    unwrap: bool = False,
    missing: Missing = "refuse",
    trust: bool = False,
) -> Capture:
    """Read a scene and its photographs.

    Args:
        path: a Mitsuba XML scene, or a capture folder (with ``capture.json``).
        images: folder with ``view_0000.exr``, ... in the order of the sensors; by default
            the capture folder, the scene's folder, or ``images`` beside the scene. If it has
            a ``capture.json`` with sensors, those are the photographs' poses.
        shape: id of the target; by default the only mesh (with a principled BSDF).
        defines: values for the scene's ``<default>`` parameters.
        unwrap: lay out new UVs even if the mesh has some. A mesh without UVs is unwrapped
            anyway, with a warning; the result is kept as ``unwrapped.ply`` with the images.
        missing: what to do with sensors that have no photograph: ``refuse``, or ``leave out``
            (they become views that are not used, of NaN that takes no memory, so that
            ``Candidates.without_photograph`` finds them).
        trust: let the scene load libraries as Mitsuba plugins, from ``plugins`` beside it or in
            the working directory; only for scenes of people you know. A library never replaces
            a plugin of Mitsuba's own.

    Raises:
        OptionError: another word for ``missing``.
        SvuEnvironmentError: no suitable Mitsuba variant is active.
        SceneError: the scene cannot be loaded or lacks something.
        CaptureError: photographs are missing, unreadable or do not fit.
    """
    require_variant()
    if missing not in get_args(Missing):
        raise OptionError(
            f"load_capture(): missing must be one of {', '.join(map(repr, get_args(Missing)))}, "
            f"got {missing!r}."
        )
    path = Path(path)
    folder = Path(images) if images is not None else photographs_of(path)
    description = capture_folder.read(folder) or Description()
    xml = path if path.suffix.lower() == ".xml" else description.scene
    if xml is None and path.is_dir():
        xml = (capture_folder.read(path) or Description()).scene
    if xml is None:
        raise CaptureError(
            f"{path}: neither a Mitsuba XML scene nor a capture folder that names one; give the "
            "scene, and this folder as --images."
        )
    if xml != path and not xml.is_file():
        raise CaptureError(
            f"{folder / capture_folder.FILE}: its scene {excerpt(xml, 300)} does not exist; "
            "copy it there, or give the scene, and this folder as --images."
        )
    # What the caller says wins over what the folder remembers.
    description = dataclasses.replace(
        description,
        scene=xml,
        shape=shape or description.shape,
        defines={**description.defines, **(defines or {})},
    )
    scene = load_scene(xml, description.defines, trust=trust)
    sensors = description.make_sensors(folder) or find_sensors(scene, str(xml))
    return read_capture(scene, sensors, folder, description, unwrap=unwrap, missing=missing)


def read_capture(
    scene: Any,
    sensors: Sequence[Any],
    folder: Path,
    description: Description,
    *,
    unwrap: bool = False,
    missing: Missing = "refuse",
) -> Capture:
    """Read the photographs of a folder for a live scene (see ``load_capture``)."""
    label = str(description.scene or folder)
    find_environment(scene, label)
    target = find_shape(scene, description.shape, label)
    paths = find_images(folder, len(sensors), missing)
    exposures = _exposures(description.exposures, len(sensors), folder)
    photographs = read_photographs(paths, [film_size(each) for each in sensors], exposures)
    runs = {p: each.run for p, each in zip(paths, photographs, strict=True) if p is not None}
    capture_folder.require_one_run(folder, runs, description.run)
    notes, used = _judge(photographs, paths)
    mesh, note = _texel_mesh(target, unwrap, folder)
    for sentence in notes + note:
        warnings.warn(sentence, SvuWarning, stacklevel=3)
    return Capture(
        scene=scene,
        shape=target,
        mesh=mesh,
        sensors=tuple(sensors),
        images=tuple(photograph.pixels for photograph in photographs),
        masks=tuple(photograph.mask for photograph in photographs),
        exposures=tuple(exposures),
        names=tuple(_name(path, view) for view, path in enumerate(paths)),
        unusable=tuple(p.invalid + p.marked + p.saturated for p in photographs),
        used=used,
        source=folder,
        warnings=tuple(notes + note),
    )


def photographs_of(path: Path) -> Path:
    """Return where the photographs of a scene or capture are when nobody says.

    A capture folder holds them itself; those of a scene are in ``images`` beside it, or in
    its own folder.

    Raises:
        CaptureError: ``path`` does not exist.
    """
    if path.is_dir():
        return path
    if not path.exists():
        raise CaptureError(f"{path}: no such file or folder; give a Mitsuba scene or a capture.")
    beside = path.parent / "images"
    return beside if has_photographs(beside) else path.parent


def has_photographs(folder: Path) -> bool:
    """Return whether a folder has any ``view_NNNN`` image."""
    return next(folder.glob("view_*"), None) is not None


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


def _name(path: Path | None, view: int) -> str:
    return f"view_{view:04d}.exr" if path is None else path.name


def _judge(
    photographs: Sequence[Photograph], names: Sequence[Path | None]
) -> tuple[list[str], tuple[bool, ...]]:
    """Say what was found in the photographs; leave out those without any light."""
    notes = []
    for photograph, name in zip(photographs, names, strict=True):
        if name is None:
            continue
        notes += [f"{name}: {remark}" for remark in photograph.remarks]
        if photograph.bits:
            notes.append(
                f"{name}: {NOT_HDR[photograph.bits]}{photograph.saturated} saturated pixels left "
                "out. Clipped highlights hide gloss: use HDR."
            )
        if photograph.invalid:
            notes.append(
                f"{name}: {photograph.invalid} pixels are NaN, infinite or negative; left out."
            )
        if photograph.black:
            notes.append(
                f"{name}: the photograph is entirely black; the view is left out. "
                "Check its exposure, or remove it with its sensor."
            )
    used = tuple(not photograph.black for photograph in photographs)
    if photographs and not any(used):
        taken = [name for name in names if name is not None]
        raise CaptureError(
            f"{taken[0].parent}: all {len(taken)} photographs are entirely black; "
            "check the exposure and the channel names of the files."
        )
    return notes, used


def _texel_mesh(shape: Any, unwrap: bool, folder: Path | None) -> tuple[Any, list[str]]:
    if has_uvs(shape) and not unwrap:
        return shape, []
    reason = "has no UVs" if not has_uvs(shape) else "is unwrapped again, as requested"
    kept = "" if folder is None else f"; they are kept in {folder / UNWRAPPED}"
    note = f"Shape '{shape.id()}' {reason}: UVs are laid out by xatlas{kept}."
    return unwrapped(shape, folder), [note]
