"""What several tests use: a sphere with one chart, scenes around it, and ``svu`` itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.poses import sphere_sensors
from svu_mi.capture.record import Capture
from svu_mi.cli.main import main
from svu_mi.scenes import meshes

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


def names(folder: Path) -> list[str]:
    """Return the names of a folder's files, in order."""
    return sorted(path.name for path in folder.iterdir())


def ball(columns: int = 48, rows: int = 24) -> capture_mesh.MeshArrays:
    """A unit sphere with exact normals and a lat-long chart."""
    theta = np.linspace(0, np.pi, rows + 1)
    profile = np.stack([np.sin(theta), np.cos(theta)], axis=-1)
    points, faces, uvs = meshes.sheet(meshes.revolve(profile, columns), (0, 0), (1, 1))
    return capture_mesh.MeshArrays(points, faces, points.copy(), uvs)


def write_ball(folder: Path, **changes: Any) -> Path:
    """Write ``ball.ply``; ``uvs=None`` and the like change its arrays."""
    arrays = ball()
    fields = {"positions": arrays.positions, "faces": arrays.faces, "normals": arrays.normals,
              "uvs": arrays.uvs, **changes}  # fmt: skip
    path = folder / "ball.ply"
    capture_mesh.make("ball", capture_mesh.MeshArrays(**fields)).write_ply(str(path))
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


def memory_capture(
    scene: Any, images: list[np.ndarray], sensors: Any, **changes: Any
) -> Capture:
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
    images = [
        np.array(mi.render(scene, sensor=sensor, spp=spp, seed=index))[..., :3]
        for index, sensor in enumerate(sensors)
    ]
    return memory_capture(scene, images, sensors)
