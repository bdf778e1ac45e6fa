"""A rendered data set in the layout of Stanford-ORB.

As in the data set, each capture has a separate world frame, cameras are rolled, and each test
photograph has the light in the frame of its camera. Textures and light are known exactly.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from svu_mi.bench.captures import scene_digests
from svu_mi.bench.cases import Case, own_cases
from svu_mi.bench.experiment import BenchRun
from svu_mi.bench.orb.orb_results import OrbCapture, OrbPhotograph, write_orb
from svu_mi.bench.orb.orb_targets import albedo_pictures
from svu_mi.bench.result_cache import Store
from svu_mi.capture.importers.stanford_orb import SUFFIXES, TRUTH
from svu_mi.capture.mesh import arrays
from svu_mi.capture.rendering import object_mask
from svu_mi.capture.scene import find_environment, load_scene, to_world
from svu_mi.capture.sensors import affine, describe, make_sensor, sphere_sensors
from svu_mi.capture.target import find_target
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.light.latlong import directions, radiance_from

LOWEST = -0.4  # sine of the elevation of the lowest camera
ROLL = 20.0  # standard deviation of the roll in degrees
SHIFT = 0.3  # standard deviation of the origin of each world, in radii of the object


@dataclass(frozen=True, kw_only=True)
class DatasetSizes:
    """Sizes of a rendered data set.

    Attributes:
        train: Photographs per capture for the recovery of textures.
        test: Photographs per capture for the comparison with results.
        film: Pixels per side.
        spp: Samples per pixel of ``train`` photographs.
        test_spp: Samples per pixel of ``test`` photographs, whose noise limits all scores.
        environment: Rows of the environment maps, half the number of columns.
    """

    train: int = 40
    test: int = 4
    film: int = 128
    spp: int = 64
    test_spp: int = 512
    environment: int = 256


OWN = DatasetSizes()
OWN_QUICK = DatasetSizes(train=16, test=2, film=64, spp=32, test_spp=256, environment=128)


def own_dataset(bench: BenchRun) -> Path:
    """Return the folder of a data set of svu_mi's scenes; render it the first time.

    Raises:
        OutputError: The folder cannot be written.
    """
    sizes = OWN_QUICK if bench.quick else OWN
    store, cases = Store(bench.folder / "orb"), own_cases(quick=True)
    folder = store.folder / "data"

    def render() -> dict[str, Any]:
        render_dataset(folder, cases, sizes, bench.progress)
        return {"sizes": sizes}

    settings = sizes, [(case.name, scene_digests(case)) for case in cases]
    bench.recall(store, "data", "Rendering a data set", settings, render)
    return folder


def render_dataset(
    root: str | Path, cases: Sequence[Case], sizes: DatasetSizes, progress: Progress | None = None
) -> None:
    """Render objects under lights, with all bounces, into ``root``.

    Captures are named ``OBJECT_scene001``, ... in the order of the lights. Equal arguments give
    equal files.

    Args:
        root: Folder of the data set.
        cases: Objects x lights.
        sizes: Numbers and sizes of photographs.
        progress: Progress display.

    Raises:
        OptionError: No photograph for training or for tests.
        SceneError: A scene cannot be loaded.
        OutputError: The folder cannot be written.
    """
    if min(sizes.train, sizes.test) < 1:
        raise OptionError(
            "A data set needs at least one photograph for training and one for tests."
        )
    progress = progress or Progress()
    # Photographs of the data set contain indirect light.
    ordered = sorted(cases, key=lambda case: case.object)
    for name, lights in groupby(ordered, key=lambda case: case.object):
        captures, mesh = [], None
        for number, case in enumerate(lights, 1):
            with progress.stage(f"Rendering {case.title}"):
                scene = load_scene(case.scene, {**case.defines, "max_depth": "6"})
                shape = find_target(scene, None, str(case.scene)).mesh
                mesh = arrays(shape)
                captures.append(_capture(f"{name}_scene{number:03d}", scene, shape, sizes))
        if mesh is not None:
            write_orb(root, mesh, captures)


def _capture(name: str, scene: Any, shape: Any, sizes: DatasetSizes) -> OrbCapture:
    seed = zlib.crc32(name.encode())
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    world = affine(rotation, SHIFT * rng.normal(size=3))
    film = (sizes.film, sizes.film)
    placed = sphere_sensors(shape, sizes.train + sizes.test, film, lowest=LOWEST)
    sensors = [_rolled(sensor, rng.normal(scale=ROLL)) for sensor in placed]
    tested = [int((k + 0.5) * len(sensors) / sizes.test) for k in range(sizes.test)]
    shots = [
        _photograph(scene, shape, sensor, world, sizes, seed + k, tested=k in tested)
        for k, sensor in enumerate(sensors)
    ]
    return OrbCapture(
        name=name,
        x_fov=describe(sensors[0])["x_fov"],
        world=world,
        train=[shot for k, shot in enumerate(shots) if k not in tested],
        test=[shots[k] for k in tested],
    )


def _rolled(sensor: Any, degrees: float) -> Any:
    record = describe(sensor)
    roll = affine(Rotation.from_euler("z", degrees, degrees=True).as_matrix())
    return make_sensor({**record, "to_world": np.array(record["to_world"]) @ roll}, sensor.id())


def _photograph(
    scene: Any,
    shape: Any,
    sensor: Any,
    world: np.ndarray,
    sizes: DatasetSizes,
    seed: int,
    *,
    tested: bool,
) -> OrbPhotograph:
    spp = sizes.test_spp if tested else sizes.spp
    image = np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed % 2**32))[..., :3]
    pose = to_world(sensor)
    environment = albedo = None
    if tested:
        # As in the data set, the first and last rows are half a row away from the poles.
        grid = directions(2 * sizes.environment, 2 * sizes.environment + 1)[1::2]
        emitter = find_environment(scene, "The scene")
        light = radiance_from(emitter, grid.reshape(-1, 3) @ pose[:3, :3].T)
        environment = light.reshape(grid.shape)
        (albedo,) = albedo_pictures(scene, [sensor])
    return OrbPhotograph(
        image=image,
        mask=object_mask(scene, shape, sensor),
        to_world=world @ pose,
        environment=environment,
        albedo=albedo,
    )


def find_captures(data: str | Path) -> tuple[Path, ...]:
    """Return the folders of all captures of a data set, sorted by name.

    Args:
        data: Folder of the data set.

    Raises:
        OptionError: The folder contains no capture.
    """
    kind = next(iter(SUFFIXES))  # high dynamic range
    folder = Path(data) / kind
    captures = sorted(path.parent for path in folder.glob("*/transforms_train.json"))
    if not captures:
        raise OptionError(
            f"{folder}: no capture found (a folder with transforms_train.json); give the folder "
            f"that contains {kind} and {TRUTH} of Stanford-ORB."
        )
    return tuple(captures)
