"""Writing of capture folders from imported sources."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import Context, copy_context
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import drjit as dr
import numpy as np

from svu_mi.capture import capture_folder, scene_xml
from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.capture import Flash
from svu_mi.capture.capture_folder import Description
from svu_mi.capture.image_io import ImageFile, open_image
from svu_mi.capture.importers.axis_fixes import (
    FIXES,
    AxisFix,
    correct_mesh,
    correct_poses,
    find_fixes,
    fix_rotation,
)
from svu_mi.capture.importers.convert_photographs import (
    ConvertedPhotograph,
    convert_photograph,
    photograph_notes,
    with_response,
)
from svu_mi.capture.importers.duplicate_frames import duplicate_notes
from svu_mi.capture.importers.envmap import write_environment
from svu_mi.capture.importers.exposure_list import EQUAL, with_gains
from svu_mi.capture.importers.import_options import ImportOptions, Light
from svu_mi.capture.importers.mesh_files import TexturedMesh, read_textured_mesh, require_mesh_file
from svu_mi.capture.importers.mesh_materials import write_pictures
from svu_mi.capture.importers.nerfstudio_world import find_normalisation, in_world_of_poses
from svu_mi.capture.importers.resampling import square_pixel_frame, with_size
from svu_mi.capture.importers.simplify_mesh import simplify
from svu_mi.capture.importers.source import Frame, Source
from svu_mi.capture.importers.source_files import relative_name
from svu_mi.capture.load_warnings import (
    MOST,
    RELATIVE_GAINS,
    back_face_share,
    faces_outward,
    too_few_for_light,
)
from svu_mi.capture.mesh import MeshArrays
from svu_mi.capture.mesh_scale import wrong_scale
from svu_mi.capture.normal_map import MIRRORED, mirrored_share
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.scene import require_variant, to_world
from svu_mi.capture.unwrap import unwrap
from svu_mi.capture.up_direction import up_of_poses
from svu_mi.capture.uv_charts import unusable_uvs
from svu_mi.core.io.output_folder import writing
from svu_mi.core.memory import Sizes
from svu_mi.core.validation import require_views
from svu_mi.errors import CaptureError, OptionError, are

SCENE, MESH, ENVIRONMENT, OBJECT = "scene.xml", "mesh.ply", "environment.exr", "object"
TABLE = 4.0  # side of a table, in diagonals of the object
NEW_UVS = "import again with --geometry-only, which computes new UVs and ignores textures"
MAX_DEPTH = 6  # path depth for renderings of the written scene
PIXELS_AT_A_TIME = 2**26  # pixels that are converted in parallel, about 60 bytes each
TABLE_IN_THE_DARK = (
    "--table: without a light, the light is estimated as if no table were there, which makes "
    "roughness and metallic worse than without --table: give the light (--environment), or omit "
    "--table."
)
NO_LIGHT = (
    "The capture has no light. Commands estimate it from the photographs; svu light shows the "
    "estimate. If you have an environment map, import again with --environment."
)


def import_capture(
    source: Source,
    folder: str | os.PathLike[str],
    options: ImportOptions | None = None,
    *,
    words: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Write a capture folder: ``scene.xml`` with its files, photographs, ``capture.json``.

    The folder is created or replaced in one step at the end.

    Args:
        source: capture of another tool, from ``read_source``.
        folder: path of the folder. An earlier import is replaced; other or edited files are an
            error.
        options: import options; defaults if None.
        words: arguments of ``svu import`` without the folder, for ``capture.json``.
        progress: callback with (photographs done, total).

    Returns:
        Sentences about decisions and changes.

    Raises:
        CaptureError: a photograph, a mask or the environment map is missing or damaged.
        MeshError: the mesh is missing or damaged.
        OptionError: an option is out of range, or no mesh is given.
        OutputError: the folder cannot be written, or contains other files.

    Example:
        >>> from svu_mi.capture.importers.source import Source, frame_of
        >>> files = [capture.source / name for name in capture.names]
        >>> frames = list(map(frame_of, capture.sensors, files))
        >>> source = Source(format="mine", root=capture.source, frames=frames)
        >>> notes = svu.import_capture(
        ...     source, "imported", svu.ImportOptions(mesh="scenes/vase/mesh.ply", every=3)
        ... )
        >>> svu.load_capture("imported", light="optional").count
        4
    """
    return plan_import(source, options or ImportOptions()).write(folder, words, progress).notes


class Imported(NamedTuple):
    """Sentences about an import, and the ``mesh_scale`` that corrects a wrong unit, or None."""

    notes: list[str]
    mesh_scale: float | None


@dataclass(frozen=True)
class ImportPlan:
    """Planned import, before any pixel is read; frames have the size of their files."""

    source: Source
    options: ImportOptions
    fixes: Sequence[AxisFix]
    frames: Sequence[Frame]
    mesh: str
    light: Light | None
    notes: Sequence[str]
    exposures_known: bool
    relative_gains: bool

    @property
    def sizes(self) -> Sizes:
        """Sizes of the photographs that are in memory at the same time, and of the light."""
        largest = sorted((frame.size for frame in self.frames), key=lambda size: size[0] * size[1])
        light = (0, 0) if self.light is None else open_image(self.light.path).size
        return Sizes(largest[-_parallel_count(self.frames) :], light)

    def write(
        self, folder: str | os.PathLike[str], words: Sequence[str] = (),
        progress: Callable[[int, int], None] | None = None,
    ) -> Imported:  # fmt: skip
        """Write the capture folder (see ``import_capture``)."""
        source, options, frames, light = self.source, self.options, self.frames, self.light
        with writing(folder, "import", capture_folder.FILE) as draft:
            geometry, scale = self._read_object()
            squares, views = _write_photographs(frames, draft.folder, options.shrink, progress)
            notes = [*source.notes, *self.notes, *geometry.notes, *photograph_notes(frames, views)]
            if light is not None:
                light = replace(light, to_world=light.to_world @ fix_rotation(self.fixes, "light"))
            sensors = [frame.sensor(_clip_planes(frame, geometry.mesh)) for frame in squares]
            table = self._table(geometry.mesh, sensors)
            cameras = [scene_xml.sensor(each, f"view_{k:04d}") for k, each in enumerate(sensors)]
            notes += _write_scene(draft.folder, geometry, light, [*table, *cameras])
            if light is None and table:
                notes.append(TABLE_IN_THE_DARK)
            if light is None and options.flash is None:
                seen = sum(not photograph.empty for photograph in views)
                notes.append(too_few_for_light(seen) or NO_LIGHT)
            imported = {
                "format": source.format, "from": str(source.root), "fixes": list(options.fixes),
                "photographs": [relative_name(source.root, frame.taken) for frame in squares],
                "mesh_scale": float(options.mesh_scale), "notes": notes,
                **({"options": list(words)} if words else {}),
                **({"relative_gains": True} if self.relative_gains else {}),
            }  # fmt: skip
            description = Description(
                scene=draft.folder / SCENE, shape=OBJECT, imported=imported,
                exposures=[frame.exposure for frame in squares] if self.exposures_known else [],
                flash=options.flash and Flash(options.flash, options.flash_intensity),
            )  # fmt: skip
            capture_folder.write(draft, description, sensors)
        return Imported(notes, scale)

    def _table(self, mesh: MeshArrays, sensors: Sequence[Any]) -> list[Element]:
        """Return the shape of the table in the scene, if there is one."""
        if self.options.table is None:
            return []
        up = up_of_poses(np.array(list(map(to_world, sensors))))
        if self.options.world_up is not None:
            up = np.eye(3)["xyz".index(self.options.world_up)]
        pose = table_pose(mesh, up)
        pose[:3, 3] += self.options.table * pose[:3, 2] / np.linalg.norm(pose[:3, 2])
        shape = scene_xml.plugin("shape", "rectangle", id="table", to_world=pose)
        albedo = [self.options.table_albedo] * 3
        shape.append(scene_xml.plugin("bsdf", "diffuse", reflectance=albedo))
        return [shape]

    def _read_object(self) -> tuple[TexturedMesh, float | None]:
        """Read the mesh, correct and scale it, and compute missing UVs.

        Also returns the scale that corrects a wrong unit, or None.
        """
        label, options = self.mesh, self.options
        geometry = read_textured_mesh(label, geometry_only=options.geometry_only)
        if options.faces is not None:
            small, fewer = simplify(geometry.mesh, options.faces, label)
            geometry = replace(geometry, mesh=small, notes=[*geometry.notes, *fewer])
        sensors = [square_pixel_frame(frame)[0].sensor() for frame in self.frames]
        mesh, notes = self._in_world_of_poses(geometry.mesh, sensors)
        for fix in self.fixes:
            if fix.kind in ("mesh", "texture", "winding"):
                mesh = correct_mesh(mesh, fix)
        mesh = replace(mesh, positions=mesh.positions * options.mesh_scale)
        scale = None
        if wrong := wrong_scale(mesh.positions, sensors, self.source.points):
            notes.append(f"{label}: {wrong.sentence(options.mesh_scale)}")
            scale = wrong.factor and wrong.factor * options.mesh_scale
        else:
            mesh, turned = _facing_cameras(mesh, self.frames, self.fixes, label)
            notes += turned
        if mesh.uvs is None:
            mesh = capture_mesh.arrays(unwrap(capture_mesh.make_mesh(OBJECT, mesh), label))
            notes.append(f"{label}: has no UVs; UVs by xatlas are stored in {MESH}.")
        elif problem := unusable_uvs(mesh, label, NEW_UVS):
            notes.append(problem)
        normals = geometry.normals
        if normals is not None and (share := mirrored_share(mesh)) > MIRRORED:
            normals = None
            notes.append(
                f"{label}: its normal map is ignored, because {share:.1%} of its UVs are mirrored."
            )
        notes = [*geometry.notes, *notes]
        return replace(geometry, mesh=mesh, normals=normals, notes=notes), scale

    def _in_world_of_poses(
        self, mesh: MeshArrays, sensors: Sequence[Any]
    ) -> tuple[MeshArrays, list[str]]:
        """Undo the normalisation of nerfstudio's meshes, if its file is near; return notes."""
        if self.source.applied is None:
            return mesh, []
        path = find_normalisation([Path(self.mesh).parent, self.source.root])
        if path is None:
            return mesh, []
        return in_world_of_poses(mesh, path, self.source.applied, sensors)


def plan_import(source: Source, options: ImportOptions) -> ImportPlan:
    """Find the files of an import, and read their headers (see ``import_capture``)."""
    require_variant()
    up = {("y", "z"): ["mesh-x90"], ("z", "y"): ["mesh-x270"]}
    between = up.get((options.mesh_up or "", options.world_up or ""), [])
    fixes = find_fixes([*between, *options.fixes])
    mesh, light = options.mesh or source.mesh, options.environment or source.light
    if light is not None and not light.path.is_file():
        raise CaptureError(
            f"{light.path}: no such environment map; give an HDR or EXR map with --environment."
        )
    if mesh is None:
        raise OptionError(f"{source.root}: contains no mesh of the object; give it with --mesh.")
    require_mesh_file(Path(mesh))
    there, left_out = _existing_frames(source, options)
    gained, known, about_gains = with_gains(there, options.exposures)
    frames = _prepare_frames(gained, source, options, fixes)
    fitted = options.exposures not in (None, "exif") or (light is not None and light.scale != 1)
    relative = not fitted and any(
        max(a.exposure, b.exposure) >= EQUAL * min(a.exposure, b.exposure)
        for a, b in zip(gained, there, strict=True)
    )
    about_gains += [RELATIVE_GAINS] * (relative and light is not None)
    notes = [
        *left_out, *_resized_notes(there, frames, source),
        *duplicate_notes(frames, str(source.root)), *about_gains,
    ]  # fmt: skip
    return ImportPlan(source, options, fixes, frames, str(mesh), light, notes, known, relative)


def _parallel_count(frames: Sequence[Frame]) -> int:
    """Return the number of photographs that are converted in parallel."""
    largest = max(frame.size[0] * frame.size[1] for frame in frames)
    return max(1, min(dr.thread_count(), PIXELS_AT_A_TIME // largest))


def _existing_frames(source: Source, options: ImportOptions) -> tuple[list[Frame], list[str]]:
    """Return the requested frames with a photograph, and a note about missing ones."""
    asked = source.frames[:: options.every]
    require_views(len(asked), f"{source.root}: photographs", CaptureError)
    there = [frame for frame in asked if frame.image.is_file()]
    absent = [frame for frame in asked if not frame.image.is_file()]
    if not absent:
        return there, []
    lack = (
        f"{source.root}: {len(absent)} of {len(asked)} photographs {are(len(absent))} missing, "
        f"first {relative_name(source.root, absent[0].image)}"
    )
    if not there:
        raise CaptureError(f"{lack}; move them to the paths in the poses.")
    if options.missing == "refuse":
        raise CaptureError(f"{lack}; add them, or continue without them by --missing leave-out.")
    return there, [f"{lack}; ignored."]


def _prepare_frames(
    there: Sequence[Frame], source: Source, options: ImportOptions, fixes: Sequence[AxisFix]
) -> list[Frame]:
    """Return frames with corrected poses, scaled to the size of their photographs."""
    if not there:
        raise CaptureError(f"{source.root}: has no photographs.")
    frames = []
    given = with_response(there, options.response)
    for frame, picture in zip(given, _fitted_pictures(given), strict=True):
        poses = frame.to_world[None]
        for fix in fixes:
            if fix.kind == "camera":
                poses = correct_poses(poses, fix, source.camera_axes)
        if picture.header.cropped:
            raise CaptureError(
                f"{frame.image}: its data window differs from its display window, so its pixels "
                "do not match the camera; save it again without crop or overscan."
            )
        frame = replace(frame, to_world=poses[0], upright=picture.upright)
        frames.append(with_size(frame, picture.size))
    return frames


def _resized_notes(
    calibrated: Sequence[Frame], frames: Sequence[Frame], source: Source
) -> Iterator[str]:
    """Yield a note about photographs whose size differs from the calibrated size."""
    resized = [
        pair for pair in zip(calibrated, frames, strict=True) if pair[0].size != pair[1].size
    ]
    if resized:
        before, after = resized[0]
        yield (
            f"{source.root}: {len(resized)} of {len(frames)} photographs {are(len(resized))} "
            f"resized, first {relative_name(source.root, after.image)} ({after.size[0]} x "
            f"{after.size[1]} pixels instead of {before.size[0]} x {before.size[1]}); their "
            "cameras are scaled alike."
        )


def _fitted_pictures(frames: Sequence[Frame]) -> list[ImageFile]:
    """Return all pictures as stored if one fits its camera only so, else upright.

    Programs either follow all EXIF orientations or none.
    """
    pictures = [open_image(frame.image) for frame in frames]
    fitted = [p.fitted(frame.size) for p, frame in zip(pictures, frames, strict=True)]
    upright = all(picture.upright for picture in fitted)
    return [replace(picture, upright=upright) for picture in pictures]


def _clip_planes(frame: Frame, mesh: MeshArrays) -> tuple[float, float]:
    """Return near and far planes for the size and distance of the object."""
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    distance = np.linalg.norm(frame.to_world[:3, 3] - (low + high) / 2)
    reach = float(max(distance, np.linalg.norm(high - low) / 2))
    return reach * 1e-2, reach * 1e2


def _facing_cameras(
    mesh: MeshArrays, frames: Sequence[Frame], fixes: Sequence[AxisFix], label: str
) -> tuple[MeshArrays, list[str]]:
    """Flip an open surface that is seen from behind, unless a fix is given; return notes."""
    scene = make_scene([capture_mesh.make_mesh(OBJECT, mesh)])
    behind = back_face_share(scene, mesh, [frame.to_world[:3, 3] for frame in frames])
    if behind < MOST:
        return mesh, []
    what = "its triangles are flipped."
    if any(fix.kind == "winding" for fix in fixes):
        what = "--fix mesh-inside-out is the cause: omit it if that was not intended."
    elif faces_outward(mesh):
        what = (
            "it is closed, so the cameras are inside: check that mesh and poses have the same unit "
            "(--mesh-scale)."
        )
    else:
        mesh = correct_mesh(mesh, FIXES["mesh-inside-out"])
    return mesh, [
        f"{label}: {behind:.0%} of its visible area are back faces, where nothing is estimated; "
        f"{what}"
    ]


def _write_photographs(
    frames: Sequence[Frame], folder: Path, shrink: float,
    progress: Callable[[int, int], None] | None,
) -> tuple[Sequence[Frame], list[ConvertedPhotograph]]:  # fmt: skip
    """Write ``view_0000.exr``, ...; return their frames (square pixels) and properties."""
    squares, scales = zip(*(square_pixel_frame(frame, shrink) for frame in frames), strict=True)
    views = [folder / f"view_{index:04d}.exr" for index in range(len(frames))]
    contexts = [copy_context() for _ in frames]  # threads do not inherit the run's marks
    converted: list[ConvertedPhotograph] = []
    with ThreadPoolExecutor(_parallel_count(frames)) as threads:
        work = contexts, [convert_photograph] * len(frames), frames, views, scales
        for photograph in threads.map(Context.run, *work):
            converted.append(photograph)
            if progress is not None:
                progress(len(converted), len(frames))
    if all(photograph.empty for photograph in converted):
        raise CaptureError(
            f"{frames[0].mask or frames[0].image}: this mask and all others are empty; "
            "in a mask, white is the object."
        )
    return squares, converted


def _write_scene(
    folder: Path, geometry: TexturedMesh, light: Light | None, others: Sequence[Element]
) -> list[str]:
    """Write the scene, its mesh, textures and light; return sentences about the light.

    ``others`` are the table and the sensors.
    """
    capture_mesh.write_ply(folder / MESH, OBJECT, geometry.mesh)
    normals = {} if geometry.normals is None else {"normals": geometry.normals}
    write_pictures({**geometry.textures, **normals}, folder)
    root = scene_xml.scene()
    root.append(scene_xml.plugin("integrator", "path", max_depth=MAX_DEPTH))
    notes: list[str] = []
    if light is not None:
        pose, notes = write_environment(light, folder / ENVIRONMENT)
        root.append(scene_xml.plugin(
            "emitter", "envmap", id="environment", filename=ENVIRONMENT, to_world=pose
        ))  # fmt: skip
    shape = scene_xml.plugin("shape", "ply", id=OBJECT, filename=MESH)
    material = scene_xml.plugin("bsdf", "principled", id=f"{OBJECT}_material")
    for name in geometry.textures:
        raw = name != "base_color"  # which is sRGB
        material.append(scene_xml.bitmap(name, f"{name}.png", raw=raw, id=name))
    if normals:
        tilted = scene_xml.plugin("bsdf", "normalmap")
        tilted.extend([scene_xml.bitmap("normalmap", "normals.png"), material])
        material = tilted
    shape.append(material)
    root.append(shape)
    root.extend(others)
    scene_xml.write_document(root, folder / SCENE)
    return notes


def table_pose(mesh: MeshArrays, up: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a ``rectangle`` below a mesh, which touches its lowest point."""
    center = (mesh.positions.min(axis=0) + mesh.positions.max(axis=0)) / 2
    size = TABLE / 2 * float(np.linalg.norm(np.ptp(mesh.positions, axis=0)))
    sides = np.linalg.svd(up[None])[2][1:]
    pose = np.eye(4)
    pose[:3, :3] = size * np.stack([sides[0], np.cross(up, sides[0]), up], axis=1)
    pose[:3, 3] = center + up * ((mesh.positions @ up).min() - center @ up)
    return pose
