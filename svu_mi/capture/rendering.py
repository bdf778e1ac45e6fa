"""Synthetic photographs: render a scene's sensors into a capture folder."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import folder as capture_folder
from svu_mi.capture.folder import Description
from svu_mi.capture.loading import read_capture
from svu_mi.capture.poses import describe, film_size, sphere_sensors
from svu_mi.capture.record import Capture
from svu_mi.capture.scene import (
    find_environment,
    find_sensors,
    find_shape,
    last_sentence,
    load_scene,
    require_variant,
)
from svu_mi.capture.unwrap import UNWRAPPED
from svu_mi.errors import OptionError, SceneError, excerpt
from svu_mi.exr import write_exr
from svu_mi.limits import require_render, require_spp
from svu_mi.results.writing import exchanging

MASK_GRID = 3  # mask rays per pixel side; any miss puts a pixel off the object


def render_capture(
    scene: Any,
    spp: int = 64,
    seed: int = 0,
    *,
    folder: str | Path | None = None,
    shape: str | None = None,
    views: int | None = None,
    resolution: tuple[int, int] = (512, 512),
    defines: Mapping[str, str] | None = None,
    unwrap: bool = False,
    trust: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Capture:
    """Render one photograph per sensor and read them back as a capture.

    Args:
        scene: a ``mi.Scene``, or the path of an XML file.
        spp: samples per pixel.
        seed: seed of the first view; view i uses a seed derived from it.
        folder: where ``capture.json`` and ``view_NNNN.exr`` (RGB, alpha = object mask) are put, in
            one step when all are rendered. A capture that was rendered there earlier is replaced;
            a folder that holds anything else is refused. By default a temporary folder that is
            gone after reading.
        shape: id of the target (see ``load_capture``).
        views: place this many sensors on a sphere around the target instead of using the
            scene's own.
        resolution: (width, height) of those sensors' films, in pixels.
        defines: values for the scene's ``<default>`` parameters, when it is a path.
        unwrap: lay out new UVs even if the mesh has some (see ``load_capture``).
        trust: let the scene load libraries, when it is a path (see ``load_capture``).
        progress: called with (views done, views in all).

    Raises:
        SvuEnvironmentError: no suitable Mitsuba variant is active.
        SceneError: the scene cannot be loaded or lacks something.
        OptionError: ``spp`` is below 1 or ``seed`` negative.
        OutputError: the folder cannot be written, or holds what was not rendered there.
    """
    require_variant()
    require_spp(spp)
    if seed < 0:
        raise OptionError(f"The seed must not be negative, got {seed}.")
    path = None if isinstance(scene, mi.Scene) else Path(scene)
    scene = scene if path is None else load_scene(path, defines, trust=trust)
    label = str(path or "scene")
    find_environment(scene, label)
    target = find_shape(scene, shape, label)
    if views is None:
        sensors = find_sensors(scene, label)
    else:
        sensors = sphere_sensors(target, views, resolution)
    require_render([film_size(sensor) for sensor in sensors], spp, label)
    description = Description(
        scene=path, defines=defines or {}, shape=target.id() or None,
        rendered={"spp": spp, "seed": seed},
    )  # fmt: skip
    shots = _rendered(scene, target, sensors, spp, seed)
    if folder is not None:
        with exchanging(folder, "render", capture_folder.FILE, [UNWRAPPED]) as draft:
            _write(shots, len(sensors), draft.folder, progress)
            capture_folder.write(draft, description, sensors)
        return read_capture(scene, sensors, Path(folder), description, unwrap=unwrap)
    with tempfile.TemporaryDirectory(prefix="svu-capture-") as temporary:
        _write(shots, len(sensors), Path(temporary), progress)
        capture = read_capture(scene, sensors, Path(temporary), description, unwrap=unwrap)
        return replace(capture, source=None)


def require_rendered(capture: Capture, spp: int) -> None:
    """Refuse photographs that were rendered otherwise than they would be now.

    Args:
        capture: that ``render_capture`` has left in a folder.
        spp: samples per pixel that it would take now.

    Raises:
        OptionError: the scene has other sensors now, or another ``spp`` is wanted.
    """
    if capture.source is None or (found := capture_folder.read(capture.source)) is None:
        return
    own = [describe(sensor) for sensor in find_sensors(capture.scene, str(found.scene))]
    changed = "from other sensors than the scene has now"
    if json.loads(json.dumps(own)) == list(found.sensors):
        if found.rendered.get("spp", spp) == spp:
            return
        changed = f"with --spp {excerpt(found.rendered['spp'], 20)}"
    raise OptionError(
        f"{capture.source}: was rendered {changed}; restore that, or omit --resume to start again."
    )


def _rendered(
    scene: Any, target: Any, sensors: Sequence[Any], spp: int, seed: int
) -> Iterator[dict[str, np.ndarray]]:
    """Render views when they are asked for; give the channels of each."""
    for index, sensor in enumerate(sensors):
        # Neighbouring seeds of the independent sampler are decorrelated by Mitsuba itself.
        image = _radiance(scene, sensor, spp, (seed + index) % 2**32)
        yield {"RGB": image, "A": object_mask(scene, target, sensor)}


def _write(
    shots: Iterable[dict[str, np.ndarray]], count: int, folder: Path,
    progress: Callable[[int, int], None] | None,
) -> None:  # fmt: skip
    for index, channels in enumerate(shots):
        write_exr(folder / f"view_{index:04d}.exr", channels)
        if progress is not None:
            progress(index + 1, count)


def _radiance(scene: Any, sensor: Any, spp: int, seed: int) -> np.ndarray:
    """Render (H, W, 3); a film of luminance gives three equal channels."""
    try:
        image = np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed))
    except Exception as error:  # Mitsuba raises RuntimeError for everything
        raise SceneError(
            f"Sensor '{sensor.id()}' cannot be rendered: {last_sentence(str(error))}"
        ) from error
    return image[..., :3] if image.shape[2] >= 3 else image[..., :1].repeat(3, axis=2)


def object_mask(scene: Any, target: Any, sensor: Any) -> np.ndarray:
    """Return (H, W) float32: the part of each pixel that the target covers, unoccluded."""
    width, height = film_size(sensor)
    n = MASK_GRID
    index = dr.arange(mi.UInt32, width * height * n * n)
    pixel, sub = index // (n * n), index % (n * n)
    x = mi.Float(pixel % width) + (mi.Float(sub % n) + 0.5) / n
    y = mi.Float(pixel // width) + (mi.Float(sub // n) + 0.5) / n
    ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f(x / width, y / height), mi.Point2f(0.5))
    hit = scene.ray_intersect_preliminary(ray, coherent=True)
    on_target = hit.is_valid() & (hit.shape == dr.opaque(mi.ShapePtr, target))
    covered = dr.block_sum(dr.select(on_target, mi.Float(1), mi.Float(0)), n * n)
    return np.array(covered).reshape(height, width).astype(np.float32) / (n * n)
