"""What several tests use: a sphere with one chart, scenes around it, and ``svu`` itself."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from PIL import Image

import svu_mi as svu
from svu_mi import scenes
from svu_mi.calibration.light.light_estimate import LightEstimate
from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.capture import Capture
from svu_mi.capture.importers import axis_fixes
from svu_mi.capture.importers.resampling import square_pixel_frame
from svu_mi.capture.importers.source import Frame, Source
from svu_mi.capture.rendering import render_capture
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import describe, make_sensor, sphere_sensors
from svu_mi.cli.main import main
from svu_mi.core.arrays import fibonacci, to_drjit
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.files import write_json
from svu_mi.core.io.output_folder import writing
from svu_mi.core.progress import Progress
from svu_mi.geometry.texels import texels
from svu_mi.output.texture_files import write_scene as write_recovered
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.svbrdf_textures import Textures, lay_out
from svu_mi.scenes import meshes
from svu_mi.statistics.gather_statistics import Values

STUDIO = {"type": "envmap", "filename": str(scenes.FOLDER / "lights" / "studio.exr")}
SPHERE_XML = """<scene version="3.0.0">
  <integrator type="direct"/>
  <emitter type="{emitter}" id="light"/>
  {sensors}
  <shape type="ply" id="ball">
    <string name="filename" value="ball.ply"/>
    {transform}
    <bsdf type="principled" id="paint"/>
  </shape>
  {extra}
</scene>
"""


def as_values(rows: np.ndarray) -> Values:
    """Return parameters (5, S), red, green, blue, roughness and metallic, as kernels take them."""
    red, green, blue, roughness, metallic = (
        to_drjit(mi.Float, np.asarray(row, np.float32)) for row in rows
    )
    return {"base_color": [red, green, blue], "roughness": [roughness], "metallic": [metallic]}


def unit(vectors: np.ndarray) -> np.ndarray:
    """Float64, and of unit length in that."""
    d = np.asarray(vectors, np.float64)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def unit_vectors(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Random directions (*shape, 3)."""
    return unit(rng.normal(size=(*shape, 3)))


def as_tensor(values: Any) -> mi.TensorXf:
    """Return a TensorXf of single precision."""
    values = np.asarray(values, np.float32)
    return mi.TensorXf(to_drjit(mi.Float, values.ravel()), shape=values.shape)


def random_textures(
    resolution: tuple[int, int], seed: int, low: float = 0.3, high: float = 0.7
) -> dict[str, mi.TensorXf]:
    """Textures whose texels have nothing in common."""
    (width, height), rng = resolution, np.random.default_rng(seed)
    shapes = {name: (height, width, CHANNELS[name]) for name in NAMES}
    return {name: as_tensor(rng.uniform(low, high, shape)) for name, shape in shapes.items()}


@contextmanager
def launched_kernels() -> Iterator[list[dict[str, Any]]]:
    """Give a list, which holds the kernels that have been launched within once that has ended."""
    kernels: list[dict[str, Any]] = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield kernels
        kernels += dr.kernel_history((dr.KernelType.JIT,))


def peak_memory(work: Callable[[], object]) -> int:
    """Return the bytes that Python and NumPy have taken at most."""
    tracemalloc.start()
    work()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def box_film(size: int) -> dict[str, Any]:
    """A square film of RGBA whose pixels do not mix."""
    return {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"},
            "pixel_format": "rgba"}  # fmt: skip


def bits_of(bits: Any, numbers: int, lanes: int) -> np.ndarray:
    """(N, T) bool."""
    lane = dr.arange(mi.UInt32, lanes)
    return np.array([bits.test(dr.opaque(mi.UInt32, n), lane).numpy() for n in range(numbers)])


def render_views(scene: Any, sensors: Any, spp: int, seed: int = 0) -> list[np.ndarray]:
    """Render (H, W, 3) of every sensor, with seeds that count up."""
    return [
        np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed + index))[..., :3]
        for index, sensor in enumerate(sensors)
    ]


def run(*words: object) -> int:
    """Run ``svu`` in this process, and return its status."""
    return main([str(word) for word in words])


def last_line(capsys: Any, warnings: int = 0) -> str:
    """Return the one line that ``svu`` has said about itself, after so many warnings."""
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("svu: ")]
    assert [line.startswith("svu: warning") for line in lines] == [True] * warnings + [False], lines
    return lines[-1]


def fails(capsys: Any, *words: object, warnings: int = 0) -> str:
    """Run ``svu``, expect status 2, and return its one line."""
    assert run(*words) == 2
    return last_line(capsys, warnings)


def python(*words: object, cwd: Path | None = None, **environment: str) -> Any:
    """Run Python in a process of its own, and return what it has said as text."""
    return subprocess.run(
        [sys.executable, *map(str, words)], cwd=cwd, env=os.environ | environment, text=True,
        stdin=subprocess.DEVNULL, capture_output=True, timeout=120, check=False,
    )  # fmt: skip


def names(folder: Path) -> list[str]:
    """Return the names of a folder's files, in order."""
    return sorted(path.name for path in folder.iterdir())


def write_older(folder: Path, command: str, record: str, files: Iterable[str]) -> None:
    """Write what an older run of a command has left: files that hold no more than a word."""
    with writing(folder, command, record) as draft:
        for name in files:
            (draft.folder / name).parent.mkdir(exist_ok=True)
            (draft.folder / name).write_text("older")
        write_json(draft.folder / record, draft.entries())


def ball(columns: int = 48, rows: int = 24) -> capture_mesh.MeshArrays:
    """A unit sphere with exact normals and a lat-long chart."""
    theta = np.linspace(0, np.pi, rows + 1)
    profile = np.stack([np.sin(theta), np.cos(theta)], axis=-1)
    points, faces, uvs = meshes.sheet(meshes.revolve(profile, columns), (0, 0), (1, 1))
    return capture_mesh.MeshArrays(points, faces, points.copy(), uvs)


def overlapping_balls() -> dict[str, np.ndarray]:
    """Arrays for ``write_ball``: two balls, whose charts lie on each other."""
    flat = ball()
    return {
        "positions": np.concatenate([flat.positions, 0.2 * flat.positions + [2, 0, 0]]),
        "faces": np.concatenate([flat.faces, flat.faces + len(flat.positions)]),
        "normals": np.concatenate([flat.normals] * 2), "uvs": np.concatenate([flat.uvs] * 2),
    }  # fmt: skip


def write_ball(folder: Path, **changes: Any) -> Path:
    """Write ``ball.ply``; ``uvs=None`` and the like change its arrays."""
    arrays = ball()
    fields = {"positions": arrays.positions, "faces": arrays.faces, "normals": arrays.normals,
              "uvs": arrays.uvs, **changes}  # fmt: skip
    path = folder / "ball.ply"
    capture_mesh.make_mesh("ball", capture_mesh.MeshArrays(**fields)).write_ply(str(path))
    return path


def sensor_xml(count: int, width: int = 24, height: int = 24, matrix: str = "") -> str:
    """XML of ``count`` sensors on a ring around the origin."""
    lines = []
    for index in range(count):
        angle = 2 * np.pi * index / max(count, 1)
        origin = f"{4 * np.sin(angle):.6f}, 1, {4 * np.cos(angle):.6f}"
        pose = matrix or f'<lookat origin="{origin}" target="0, 0, 0" up="0, 1, 0"/>'
        lines.append(
            f'<sensor type="perspective" id="cam{index}"><float name="fov" value="35"/>'
            f'<transform name="to_world">{pose}</transform>'
            f'<film type="hdrfilm"><integer name="width" value="{width}"/>'
            f'<integer name="height" value="{height}"/></film></sensor>'
        )
    return "\n".join(lines)


def write_scene(
    folder: Path,
    *,
    sensors: str | None = None,
    emitter: str = "constant",
    transform: str = "",
    extra: str = "",
    **changes: Any,
) -> Path:
    """Write a scene with a ball in it, and return its path."""
    write_ball(folder, **changes)
    path = folder / "scene.xml"
    path.write_text(
        SPHERE_XML.format(
            emitter=emitter,
            sensors=sensor_xml(3) if sensors is None else sensors,
            transform=transform,
            extra=extra,
        )
    )
    return path


def memory_capture(scene: Any, images: list[np.ndarray], sensors: Any, **changes: Any) -> Capture:
    """Put a capture together without files."""
    count = len(images)
    shape = scene.shapes()[0]
    fields: dict[str, Any] = {
        "scene": scene, "shape": shape, "mesh": shape, "sensors": tuple(sensors),
        "images": tuple(np.ascontiguousarray(image, np.float32) for image in images),
        "masks": (None,) * count, "exposures": (1.0,) * count,
        "names": tuple(f"view_{i:04d}.exr" for i in range(count)),
        "unusable": (0,) * count, "used": (True,) * count, **changes,
    }  # fmt: skip
    return Capture(**fields)


def require_equal_columns(capture: Capture) -> None:
    """A candidate at the place of a photograph has its columns, with lamps and their shadows."""
    estimate = svu.estimate(capture, svu.texels(capture.mesh, 12), preset="fixed")
    guidance = svu.next_best_view(estimate, capture.sensors, 1, texels=10**4)
    assert guidance._inputs is not None
    table = guidance._inputs.forecast.responses.table()
    photographed, candidate = np.split(table, 2)
    assert photographed[..., 1:].max() > 0.1
    both = (photographed[..., 0] > 0) & (candidate[..., 0] > 0)
    assert both.sum() > 0.9 * (candidate[..., 0] > 0).sum()
    np.testing.assert_allclose(photographed[both], candidate[both], rtol=1e-3, atol=1e-4)


def ball_scene(tmp_path: Path, emitter: dict[str, Any], bsdf: dict[str, Any]) -> Any:
    """A live scene with the ball."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "light": emitter,
            "ball": {"type": "ply", "filename": str(write_ball(tmp_path)), "bsdf": bsdf},
        },
        optimize=False,
    )


def render_ball(
    tmp_path: Path,
    emitter: dict[str, Any],
    bsdf: dict[str, Any],
    views: int = 24,
    resolution: tuple[int, int] = (64, 64),
    spp: int = 64,
) -> Capture:
    """Render the ball from all sides."""
    scene = ball_scene(tmp_path, emitter, bsdf)
    sensors = sphere_sensors(scene.shapes()[0], views, resolution)
    return memory_capture(scene, render_views(scene, sensors, spp), sensors)


def write_dark(capture: Path, folder: Path) -> Path:
    """Copy a capture folder of the vase, with a scene that has no light."""
    shutil.copytree(capture, folder)
    vase = folder.with_name(f"{folder.name}_scene")
    shutil.copytree(scenes.path("vase").parent, vase)
    scene = vase / "vase.xml"
    text = scene.read_text().replace('<include filename="../lights/$light.xml"/>', "")
    scene.write_text(text.replace('<default name="light" value="window"/>', ""))
    record = json.loads((folder / "capture.json").read_text())
    define = {key: value for key, value in record["define"].items() if key != "light"}
    write_json(folder / "capture.json", {**record, "scene": str(scene), "define": define})
    return folder


class Said(Progress):
    """What would be shown."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def say(self, line: str) -> None:
        self.lines.append(line)


def made_up_light(seed: int = 1, side: float = 1) -> LightEstimate:
    """Light as if found: brightest from +X (or -X, side -1), and known up to a factor."""
    rng, cells = np.random.default_rng(seed), 64
    peak = np.exp(8 * (side * fibonacci(cells)[:, 0] - 1))
    logarithm = np.log(0.5 + 12 * peak)[:, None] + 0.1 * rng.normal(size=(cells, 3))
    return LightEstimate(
        logarithm=logarithm, cell_sd=rng.uniform(0.2, 0.6, cells),
        draws=logarithm + 0.2 * rng.normal(size=(2, cells, 3)),
        scale_sd=np.array([0.2, 0.25, 0.2]), tint_sd=np.array([0.0, 0.15, 0.0]),
        misfit=(0.02, np.nan), widening=1.3, texels=99, remarks=("Nothing is seen from below.",),
    )  # fmt: skip


def foreign_source(folder: Path) -> Source:
    """What a reader would say of three cameras around the origin of a turned world.

    Photographs are not square, one has pixels that are not, principal points are off the centre,
    the second has no mask, and the third is a PNG.
    """
    rng = np.random.default_rng(20611)
    world = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    world[:, 0] *= np.linalg.det(world)
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for index, (size, focal) in enumerate((((48, 32), (70, 70)), ((30, 40), (61.5, 48)),
                                           ((48, 32), (70, 70)))):  # fmt: skip
        pose = np.eye(4)
        pose[:3, :3] = world @ axis_fixes.rotation("y", 77 * index) @ axis_fixes.rotation("x", 25)
        pose[:3, 3] = pose[:3, :3] @ [0.1, -0.2, -4.0] + [0.2, 0, 0.1]
        pixels = rng.uniform(0.01, 0.9, (size[1], size[0], 3)).astype(np.float32)
        suffix = ".png" if index == 2 else ".exr"
        image, mask = folder / f"photo{9 - index}{suffix}", folder / f"shape{index}.png"
        if suffix == ".png":
            Image.fromarray(np.uint8(255 * pixels)).save(image)
        else:
            write_exr(image, {"RGB": pixels})
        Image.fromarray(np.uint8(255 * (pixels[..., 0] > 0.5))).save(mask)
        frames.append(Frame(
            label=image.name, image=image, mask=None if index == 1 else mask, to_world=pose,
            focal=focal, center=(size[0] / 2 + 2.25, size[1] / 2 - 3.5), size=size,
        ))  # fmt: skip
    return Source(format="test", root=folder, frames=frames)


def projected(frame: Frame, points: np.ndarray) -> np.ndarray:
    """Project points (N, 3) to pixels (N, 2) by the sensor that an import would make."""
    square, scale = square_pixel_frame(frame)
    interaction = dr.zeros(mi.Interaction3f, len(points))
    interaction.p = mi.Point3f(np.array(points, np.float32).T)
    sample, _ = square.sensor().sample_direction(interaction, mi.Point2f(0.5))
    assert (np.array(sample.pdf) > 0).all()
    return np.array(sample.uv).T / scale


def lettered(width: int, height: int) -> Textures:
    """Textures that show which way is up and right: a letter F, dark to bright, dull to shiny."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    base_color = np.stack([0.2 + 0.6 * x, 0.8 - 0.6 * y, 0.3 + 0 * x], axis=-1)
    stem = (x > 0.36) & (x < 0.4) & (y > 0.28) & (y < 0.62)
    bars = (x > 0.36) & (x < 0.5) & (((y > 0.28) & (y < 0.34)) | ((y > 0.42) & (y < 0.47)))
    base_color[stem | bars] = 0.03, 0.02, 0.02
    return Textures.of({
        "base_color": base_color.astype(np.float32),
        "roughness": (0.25 + 0.5 * y)[..., None].astype(np.float32),
        "metallic": (0.7 * x * (1 - y))[..., None].astype(np.float32),
    })  # fmt: skip


def recovered_folder(
    folder: Path, textures: Textures, *, two_sided: bool = False, **changes: Any
) -> Capture:
    """Write what ``svu recover`` does but for its pictures; no part of the ball is recovered.

    Args:
        folder: an empty folder; the scene is in its ``scene``.
        textures: as if recovered.
        two_sided: whether the ball has a material on both sides.
        **changes: of the ball's arrays.
    """
    (folder / "scene").mkdir(parents=True)
    arrays = ball()
    # A chart with room around it; its poles are 0.1 and 0.8 of the way down.
    uvs = np.array([0.15, 0.1]) + np.array([0.75, 0.7]) * arrays.uvs
    scene = write_scene(folder / "scene", **{"uvs": uvs, **changes})
    capture = render_capture(scene, spp=1)
    if two_sided:
        capture.shape.set_bsdf(mi.load_dict({"type": "twosided", "b": {"type": "principled"}}))
    grid = texels(capture.mesh, textures.resolution)
    recovered = lay_out(grid, {name: textures.at(grid, name) for name in NAMES})
    write_recovered(capture, recovered, folder)
    return capture


def write_known(folder: Path, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Write entropy and coverage over that chart; its right half is unseen."""
    column = np.tile((np.arange(width) + 0.5) / width, (height, 1))
    rows = ((np.arange(height) + 0.5) / height)[:, None]
    inside = (column > 0.15) & (column < 0.9) & (rows > 0.1) & (rows < 0.8)
    seen = inside & (column < 0.525)
    entropy = np.where(seen, column, 1).astype(np.float32)
    coverage = np.where(seen, 3, 0).astype(np.float32)
    folder.mkdir(exist_ok=True)
    write_exr(folder / "entropy.exr", {"Y": entropy})
    write_exr(folder / "coverage.exr", {"Y": coverage})
    return entropy, coverage


def posed(capture: Capture, *poses: np.ndarray) -> Capture:
    """Return a capture whose cameras have other poses (4, 4); the last ones keep theirs."""
    records = [describe(sensor) for sensor in capture.sensors]
    for record, pose in zip(records, poses, strict=False):
        record["to_world"] = np.array(pose)
    return replace(capture, sensors=tuple(make_sensor(record, "posed") for record in records))


def turning(capture: Capture, spp: int = 32) -> Capture:
    """Return a capture as if on a turntable: its light, an envmap, turns with every camera.

    What the light has in world space without ``to_world``, it has in camera space now.
    """
    emitter = capture.environment
    params, images = mi.traverse(emitter), []
    pixels = np.ascontiguousarray(params["data"].numpy()[:, 1:-1])  # without what wraps around
    brightness = float(np.array(params["scale"]).ravel()[0])
    for index, sensor in enumerate(capture.sensors):
        pose = to_world(sensor)
        pose[:3, 3] = 0
        turned = mi.load_dict({
            "type": "envmap", "bitmap": mi.Bitmap(pixels), "scale": brightness,
            "to_world": mi.ScalarTransform4f(pose @ to_world(emitter)),
        })  # fmt: skip
        scene = make_scene([*capture.scene.shapes(), turned])
        direct = mi.load_dict({"type": "path", "max_depth": 2})
        image = mi.render(scene, sensor=sensor, spp=spp, seed=index, integrator=direct)
        images.append(np.array(image, np.float32)[..., :3])
        del turned, scene  # beside which the next would take kernels of their own
    return replace(capture, images=tuple(images))
