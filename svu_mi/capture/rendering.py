"""Synthetic captures: renders of a scene, one photograph per sensor."""

import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import svu_mi
from svu_mi.capture import capture_folder
from svu_mi.capture.capture import Capture
from svu_mi.capture.capture_folder import Description
from svu_mi.capture.content_hash import integrator_key, scene_key
from svu_mi.capture.film_rays import SensorPixels
from svu_mi.capture.loading import map_size, plan_photographs
from svu_mi.capture.mesh import chart_coverage
from svu_mi.capture.scene import (
    find_light,
    find_sensors,
    last_sentence,
    load_scene,
    require_variant,
)
from svu_mi.capture.sensors import describe, film_size, sphere_sensors
from svu_mi.capture.target import SceneTarget, find_target
from svu_mi.core.interrupts import between_steps
from svu_mi.core.io.exr import read_header, read_pixels, write_exr
from svu_mi.core.io.hashes import Key
from svu_mi.core.io.output_folder import Claim, claimed, writing
from svu_mi.core.io.provenance import RUN
from svu_mi.core.memory import Size, Sizes
from svu_mi.core.validation import require_render, require_spp
from svu_mi.errors import CaptureError, OptionError, OutputError, SceneError, excerpt

VIEWS = "view_*.exr"  # files that an interrupted run keeps for resuming
KEY = 16  # hexadecimal digits of the id of a run


def render_capture(
    scene: Any, spp: int = 64, seed: int = 0, *, folder: str | os.PathLike[str] | None = None,
    shape: str | None = None, views: int | None = None, resolution: tuple[int, int] = (512, 512),
    defines: Mapping[str, str] | None = None, unwrap: bool = False, trust: bool = False,
    progress: Callable[[int, int], None] | None = None, resume: bool | None = None,
) -> Capture:  # fmt: skip
    """Render one photograph per sensor and return them as a capture.

    Args:
        scene: A ``mi.Scene``, or the path of an XML file or a capture folder (its scene and
            sensors are rendered).
        spp: Samples per pixel.
        seed: Seed of the first view; view i uses ``seed + i``.
        folder: Output folder of ``capture.json`` and ``view_NNNN.exr`` (RGB, alpha is the object
            mask). It is replaced when all views are rendered. Default: a temporary folder.
        shape: Name of the target (see ``load_capture``).
        views: Number of sensors on a sphere around the target; default: the existing sensors.
        resolution: Film size (width, height) in pixels, if ``views`` is given.
        defines: Values of the scene's ``<default>`` parameters, if ``scene`` is a path.
        unwrap: True computes new UVs even if the mesh has UVs (see ``load_capture``).
        trust: True lets the scene load libraries, if ``scene`` is a path (see ``load_capture``).
        progress: Callback with the number of rendered views and of all views.
        resume: True continues an interrupted run, False starts again. Both keep finished views if
            the run is interrupted; None keeps no views.

    Raises:
        SvuEnvironmentError: No suitable Mitsuba variant is active.
        SceneError: The scene cannot be loaded or is incomplete.
        OptionError: ``spp`` is below 1 or ``seed`` is negative.
        OutputError: The folder is not writable, has other files, or has no views to resume.

    Example:
        >>> made = svu.render_capture(capture.scene, spp=1, views=3, resolution=(40, 32))
        >>> made.count, made.images[0].shape
        (3, (32, 40, 3))
    """
    plan = plan_render(
        scene, spp, seed, shape=shape, views=views, resolution=resolution, defines=defines,
        unwrap=unwrap, trust=trust, float_textures=True,
    )  # fmt: skip
    return plan.render(folder, progress=progress, resume=resume)


@dataclass(frozen=True, kw_only=True)
class RenderPlan:
    """A render job, not yet started; other attributes as for ``render_capture``.

    Attributes:
        light: Environment emitter; None if the integrator needs none.
        target: The object as a mesh. Photographs show ``scene``, which has its original shapes.
        sensors: V perspective sensors.
        description: Content of the future ``capture.json``.
    """

    scene: Any
    light: Any
    target: SceneTarget
    sensors: Sequence[Any]
    spp: int
    seed: int
    unwrap: bool
    description: Description

    @property
    def sizes(self) -> Sizes:
        """Sizes for memory estimates."""
        charts = 1.0 if self.unwrap else chart_coverage(self.target.mesh)
        return Sizes([film_size(sensor) for sensor in self.sensors], map_size(self.light), charts)

    def render(
        self, folder: str | os.PathLike[str] | None = None, *,
        progress: Callable[[int, int], None] | None = None, resume: bool | None = None,
    ) -> Capture:  # fmt: skip
        """Render the views and load them (arguments: ``render_capture``)."""
        if folder is None:
            with tempfile.TemporaryDirectory(prefix="svu-capture-") as temporary:
                self._write(Path(temporary), progress)
                return replace(self._read(Path(temporary)), source=None)
        key = "" if resume is None else self._key()
        with claimed(folder, "render", keep=VIEWS if key else "") as claim:
            if resume:
                _require_views(claim, [film_size(sensor) for sensor in self.sensors], key)
            else:
                claim.clear()
            # Resumable views store a digest of the render job.
            with writing(claim, "render", capture_folder.FILE, run=key) as draft:
                self._write(draft.folder, progress)
                capture_folder.write(draft, self.description, self.sensors)
        return self._read(Path(folder))

    def _read(self, folder: Path) -> Capture:
        plan = plan_photographs(
            self.scene, self.sensors, folder, self.description, unwrap=self.unwrap,
            light="required" if self.light else "optional",
        )  # fmt: skip
        return plan.read()

    def _write(self, folder: Path, progress: Callable[[int, int], None] | None) -> None:
        """Render and write the missing views."""
        with between_steps() as stop_if_asked:
            for index, sensor in enumerate(self.sensors):
                path = folder / _view(index)
                if not path.exists():
                    # Mitsuba decorrelates neighbouring seeds of the independent sampler.
                    seed = (self.seed + index) % 2**32
                    image = _radiance(self.scene, sensor, self.spp, seed)
                    mask = object_mask(self.target.scene, self.target.mesh, sensor)
                    write_exr(path, {"RGB": image, "A": mask})
                if progress is not None:
                    progress(index + 1, len(self.sensors))
                stop_if_asked()

    def _key(self) -> str:
        """Return a digest of all settings that affect the pixels."""
        cameras = [
            [describe(each), str(each.film()), each.sampler().class_name()] for each in self.sensors
        ]
        scene = scene_key(self.scene, self.target.mesh), integrator_key(self.scene)
        version = svu_mi.__version__, mi.__version__, mi.variant()
        return Key(*scene, self.target.name, cameras, self.spp, self.seed, version).digest()[:KEY]


def plan_render(
    scene: Any, spp: int = 64, seed: int = 0, *, shape: str | None = None, views: int | None = None,
    resolution: tuple[int, int] = (512, 512), defines: Mapping[str, str] | None = None,
    unwrap: bool = False, trust: bool = False, float_textures: bool = False,
) -> RenderPlan:  # fmt: skip
    """Load a scene and place its sensors (see ``render_capture`` and ``load_scene``)."""
    require_variant()
    require_spp(spp)
    if seed < 0:
        raise OptionError(f"The seed must not be negative, got {seed}.")
    path = None if isinstance(scene, mi.Scene) else Path(scene)
    label, own = str(path or "scene"), ()
    if path is not None:
        if known := capture_folder.read(path):
            if known.imported:
                raise SceneError(f"{label}: is imported; give a Mitsuba scene to render.")
            if known.scene is None:
                raise SceneError(f"{label}: its {capture_folder.FILE} names no scene to render.")
            if known.flash is not None:
                raise SceneError(f"{label}: the lamp on its camera cannot be rendered.")
            own, path = known.make_sensors(path), known.scene
            known = known.overridden(shape, defines)
            shape, defines = known.shape, known.defines
        scene = load_scene(path, defines, trust=trust, float_textures=float_textures)
    needs_light = getattr(scene.integrator(), "needs_light", True)
    light = find_light(scene, label) if needs_light or scene.emitters() else None
    target = find_target(scene, shape, label)
    if views is None:
        sensors = own or find_sensors(scene, label, "pass --views N to place some")
    else:
        sensors = sphere_sensors(target.mesh, views, resolution)
    require_render([film_size(sensor) for sensor in sensors], spp, label)
    description = Description(
        scene=path, defines=defines or {}, shape=target.name,
        rendered={"spp": spp, "seed": seed},
    )  # fmt: skip
    return RenderPlan(
        scene=scene, light=light, target=target, sensors=sensors, spp=spp, seed=seed,
        unwrap=unwrap, description=description,
    )  # fmt: skip


def require_rendered(capture: Capture, spp: int) -> None:
    """Raise if a capture was not rendered with ``spp`` and the sensors of its scene."""
    if capture.source is None or (description := capture_folder.read(capture.source)) is None:
        return
    own = [describe(sensor) for sensor in find_sensors(capture.scene, str(description.scene))]
    changed = "with other sensors than the scene has now"
    if json.loads(json.dumps(own)) == list(description.sensors):
        if description.rendered.get("spp", spp) == spp:
            return
        changed = f"with --spp {excerpt(description.rendered['spp'], 20)}"
    raise OptionError(
        f"{capture.source}: was rendered {changed}; restore that, or omit --resume to start again."
    )


def _require_views(claim: Claim, films: Sequence[Size], run: str) -> None:
    """Keep only complete views of ``run`` in an interrupted draft; raise without any."""
    left = list(claim.draft.glob(VIEWS))
    if not left:
        raise OutputError(f"{claim.folder}: no interrupted run to resume; omit --resume.")
    expected = {_view(index): film for index, film in enumerate(films)}
    whole = {path.name for path in left if _is_whole(path, expected.get(path.name), run)}
    if not whole:
        raise OutputError(
            f"{claim.folder}: the interrupted run had other options or another scene; restore "
            "these, or omit --resume to start again."
        )
    claim.clear(lambda path: path.name in whole)


def _is_whole(path: Path, film: Size | None, run: str) -> bool:
    """Return whether a file (not a link) is a complete view of a run."""
    if path.is_symlink() or not path.is_file():
        return False
    try:
        header = read_header(path)
        if header.size != film or header.attributes.get(RUN) != run:
            return False
        read_pixels(path, header.attributes)
    except CaptureError:
        return False
    return True


def _view(index: int) -> str:
    return f"view_{index:04d}.exr"


def _radiance(scene: Any, sensor: Any, spp: int, seed: int) -> np.ndarray:
    """Render radiance (H, W, 3), also if the film stores luminance only."""
    try:
        image = np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed))
    except Exception as error:  # Mitsuba raises RuntimeError for everything
        raise SceneError(
            f"Sensor '{sensor.id()}' cannot be rendered: "
            f"{last_sentence(str(error.__cause__ or error))}"
        ) from error
    return image[..., :3] if image.shape[2] >= 3 else image[..., :1].repeat(3, axis=2)


def object_mask(scene: Any, target: Any, sensor: Any) -> np.ndarray:
    """Return the fraction of each pixel that shows the target, (H, W) float32."""
    return SensorPixels([sensor]).covered(scene, target)[0]
