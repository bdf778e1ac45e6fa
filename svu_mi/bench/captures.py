"""Photographs of a case, subsets of them, and its true textures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.bench.cases import Case
from svu_mi.bench.image_metrics import texel_error, texture_psnr
from svu_mi.bench.problem_sizes import ProblemSizes
from svu_mi.bench.result_cache import Store, key_of
from svu_mi.capture import capture_folder
from svu_mi.capture.capture import Capture
from svu_mi.capture.loading import load_capture
from svu_mi.capture.rendering import render_capture
from svu_mi.capture.scene import to_world
from svu_mi.core.arrays import evenly_spaced
from svu_mi.core.io.hashes import digest_of_file
from svu_mi.core.io.provenance import entry_of
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.evaluation.ground_truth import ground_truth
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import NAMES
from svu_mi.recovery.svbrdf_textures import Textures

MARK = "bench"  # bench.json in the folder of a capture contains the key of its settings


def capture_of(case: Case, sizes: ProblemSizes, folder: Path, progress: Progress) -> Capture:
    """Render the photographs of a case into a folder; read them if they exist.

    Args:
        case: Object and light.
        sizes: Number and size of the photographs.
        folder: Folder of the capture.
        progress: Progress display.

    Raises:
        SceneError: The scene cannot be rendered.
        OutputError: The folder cannot be written.
    """
    key = key_of(scene_digests(case), case.defines, sizes.views, sizes.film, sizes.spp, sizes.seed)
    store = Store(folder)
    if store.load(MARK, key) is not None and _is_as_written(folder):
        with progress.stage(f"Loading {case.title}"):
            return load_capture(case.scene, folder, defines=case.defines)  # wherever it is now
    store.path(MARK).unlink(missing_ok=True)
    with progress.stage(f"Rendering {case.title}", sizes.views) as stage:
        capture = render_capture(
            case.scene, sizes.spp, sizes.seed, folder=folder, views=sizes.views,
            resolution=(sizes.film, sizes.film), defines=case.defines,
            progress=stage.update,
        )  # fmt: skip
    store.save(MARK, key, {"cell": case.name, "settings": sizes.shared})
    return capture


def _is_as_written(folder: Path) -> bool:
    """Return whether all files of a capture folder exist and are unchanged."""
    entry = entry_of(folder / capture_folder.FILE)
    return entry is not None and all(entry.owns(folder, name) for name in entry.files)


def scene_digests(case: Case) -> list[tuple[str, str]]:
    """Return (name, digest) of each file in the scene's folder, in ``lights`` and in defines."""
    folders = (case.scene.parent, case.scene.parent.parent / "lights")
    files = sorted(path for folder in folders for path in folder.rglob("*"))
    given = map(Path, case.defines.values())
    return [(path.name, digest_of_file(path)) for path in (*files, *given) if path.is_file()]


def even_views(capture: Capture, count: int) -> Capture:
    """Return the capture with ``count`` of its views, evenly spaced in their order."""
    return chosen_views(capture, evenly_spaced(capture.count, count))


def chosen_views(capture: Capture, indices: Iterable[int]) -> Capture:
    """Return the capture with the views of the given indices, in that order."""
    names = ["sensors", "images", "masks", "exposures", "names", "unusable", "used"]
    names += [name for name in ("files", "clipped", "rounding") if getattr(capture, name)]
    chosen = [int(index) for index in indices]
    views: dict[str, Any] = {
        name: tuple(getattr(capture, name)[i] for i in chosen) for name in names
    }
    return replace(capture, **views)


@dataclass(frozen=True)
class TrueTextures:
    """True textures: the material of the scene at every texel.

    Attributes:
        grid: The T texels.
        values: Values (T, C) or (T,) by parameter.
    """

    grid: Texels
    values: dict[str, np.ndarray]

    @classmethod
    def of(cls, capture: Capture, grid: Texels) -> TrueTextures:
        """Evaluate the true parameters of a capture's scene.

        Raises:
            SceneError: The material of the scene is not ``principled``.
        """
        known = ground_truth(capture, grid)
        return cls(grid, {name: getattr(known, name) for name in NAMES})

    def psnr(self, textures: Textures, where: np.ndarray) -> dict[str, float]:
        """Return the PSNR of texels ``where`` (T,) bool, by parameter and as ``average``."""
        return texture_psnr(*self._both(textures, where))

    def error(self, textures: Textures, where: np.ndarray) -> np.ndarray:
        """Return the absolute error of texels ``where`` (T,) bool, mean over parameters."""
        return texel_error(*self._both(textures, where))

    def _both(self, textures: Textures, where: np.ndarray) -> list[dict[str, np.ndarray]]:
        recovered = {name: textures.at(self.grid, name) for name in NAMES}
        return [{name: x[where] for name, x in one.items()} for one in (recovered, self.values)]


FRONT = (0.0, 0.3, 1.0)  # direction from the object to the side with most views


def capture_in_memory(scene: Any, shape: Any, sensors: Sequence[Any], images: Any) -> Capture:
    """Return a capture without masks.

    Args:
        scene: Scene with the light.
        shape: Object, with UVs.
        sensors: Sensors of V views.
        images: Photographs of V views, (H, W, 3) each.
    """
    count = len(sensors)
    return Capture(
        scene=scene, shape=shape, mesh=shape, sensors=tuple(sensors),
        images=tuple(np.ascontiguousarray(image, np.float32) for image in images),
        masks=(None,) * count, exposures=(1.0,) * count,
        names=tuple(f"view_{view:04d}.exr" for view in range(count)),
        unusable=(0,) * count, used=(True,) * count,
    )  # fmt: skip


def uneven_views(capture: Capture, front: int, back: int) -> Capture:
    """Return the capture with most of its views from one side.

    Args:
        capture: Views all around the object.
        front: Number of views with the smallest angle to the front direction.
        back: Number of other views, evenly spaced in the order of their angles.

    Raises:
        OptionError: The capture has fewer than ``front`` + ``back`` views.
    """
    if front + back > capture.count:
        raise OptionError(f"{front} + {back} views are too many; the capture has {capture.count}.")
    order = nearest_to_front(capture)
    rest = order[front:]
    others = rest[np.linspace(0, len(rest) - 1, back + 2).round().astype(int)[1:-1]]
    return chosen_views(capture, np.sort(np.concatenate([order[:front], others])))


def nearest_to_front(capture: Capture) -> np.ndarray:
    """Return the indices of all views, sorted by their angle to the front direction."""
    origins = np.array([to_world(sensor)[:3, 3] for sensor in capture.sensors])
    directions = origins - origins.mean(axis=0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axis = np.array(FRONT) / np.linalg.norm(FRONT)
    return np.argsort(-(directions @ axis), kind="stable")
