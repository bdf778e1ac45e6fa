"""Does entropy step where light ends? A ball, from the lit side through the terminator.

    python tests/records/terminator.py [--work FOLDER] [--plot FILE.png]

256 texels along circles through the direction of the light, which they cross the terminator on,
under a half-degree sun and under the window. What is compared is the step of entropy between
neighbours along the circle, by its 99th percentile: the estimate's must not be above that of a
path-traced reference (512 samples) by more than .05. Takes two minutes on two cores.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import svu_mi as svu  # first: it chooses LLVM

import mitsuba as mi  # isort: skip

ALONG, SAMPLES, ALLOWED = 256, 512, 0.05
MATERIALS = {"paint": (0.6, 0.4, 0.0), "metal": (0.8, 0.35, 1.0)}  # colour, roughness, metallic


def photographs(light: str, material: tuple[float, float, float], folder: Path) -> Any:
    """Render 60 photographs of a ball."""
    from helpers import write_ball

    from svu_mi import scenes

    color, rough, metal = material
    folder.mkdir(parents=True, exist_ok=True)
    ball = write_ball(folder)
    lights = scenes.FOLDER / "lights"
    emitter = f'<include filename="{lights / light}.xml"/>'
    if (image := lights / f"{light}.exr").exists():
        emitter = f'<emitter type="envmap"><string name="filename" value="{image}"/></emitter>'
    scene = folder / "ball.xml"
    scene.write_text(
        '<scene version="3.0.0"><integrator type="direct"/>'
        f"{emitter}"
        f'<shape type="ply"><string name="filename" value="{ball}"/><bsdf type="principled">'
        f'<rgb name="base_color" value="{color}"/><float name="roughness" value="{rough}"/>'
        f'<float name="metallic" value="{metal}"/></bsdf></shape></scene>'
    )
    return svu.render_capture(scene, 32, 0, folder=folder / "capture", views=60,
                              resolution=(256, 256))  # fmt: skip


def circle(texels: Any, toward: np.ndarray, turn: float) -> np.ndarray:
    """Return 256 texels along a great circle through a direction, each once."""
    side = np.linalg.svd(toward[None])[2][1:]
    other = np.cos(turn) * side[0] + np.sin(turn) * side[1]
    angle = np.linspace(0, np.pi, ALONG)
    points = np.cos(angle)[:, None] * toward + np.sin(angle)[:, None] * other
    position = texels.position.numpy().T
    position = position / np.linalg.norm(position, axis=1, keepdims=True)
    nearest = (points @ position.T).argmax(axis=1)
    return nearest[np.sort(np.unique(nearest, return_index=True)[1])]


def brightest(capture: Any) -> np.ndarray:
    """Return the world direction that most light comes from."""
    from svu_mi.light import light, light_cells

    cells = light_cells(light(capture, 60).environment, 64, 512).coarse
    flux = cells.flux.numpy().reshape(-1, 4)[:, 3]
    return cells.toward.numpy().reshape(-1, 4)[flux.argmax(), :3].astype(np.float64)


def measure(light: str, name: str, work: Path) -> dict[str, Any]:
    """Return entropies along two circles, and the 99th percentile of their steps."""
    capture = photographs(light, MATERIALS[name], work / f"ball_{light}_{name}")
    texels = svu.texels(capture.mesh, 512)
    toward, lines = brightest(capture), []
    for turn in (0.3, 2.0):
        chosen = circle(texels, toward, turn)
        reference = svu.reference_posterior(capture, texels, chosen, SAMPLES)
        lines.append((chosen, np.array(reference.entropy)))
    rows = {"reference": [entropy for _, entropy in lines]}
    for preset in ("default", "fast"):
        entropy = np.array(svu.estimate(capture, texels, preset=preset).entropy)
        rows[preset] = [entropy[chosen] for chosen, _ in lines]
    step = {
        row: float(np.percentile(np.concatenate([np.abs(np.diff(one)) for one in ones]), 99))
        for row, ones in rows.items()
    }
    return {"light": light, "material": name, "rows": rows, "step": step}


def draw(found: list[dict[str, Any]], file: Path) -> None:
    """Plot entropy along the circles."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(len(found), 2, figsize=(12, 3 * len(found)), squeeze=False)
    for row, one in zip(axes, found, strict=True):
        for turn, axis in enumerate(row):
            for name, lines in one["rows"].items():
                axis.plot(lines[turn], label=name, linewidth=1)
            axis.set(title=f"{one['light']}, {one['material']}, circle {turn + 1}", ylim=(0, 1.02))
    axes[0, 0].legend()
    figure.tight_layout()
    figure.savefig(file, dpi=80)


def parser() -> argparse.ArgumentParser:
    """Return what this record is asked."""
    found = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    found.add_argument("--work", type=Path, default=Path("out/records"))
    found.add_argument("--plot", type=Path)
    return found


def main() -> None:
    """Print a line per light and material; exit with 1 if the default steps too far."""
    asked = parser().parse_args()
    mi.set_variant("llvm_ad_rgb")
    found = [measure(light, name, asked.work) for light in ("clear", "window")
             for name in MATERIALS]  # fmt: skip
    for one in found:
        words = ", ".join(f"{row} {step:.3f}" for row, step in one["step"].items())
        print(f"{one['light']}, {one['material']}: 99th percentile of the step: {words}")
    if asked.plot:
        draw(found, asked.plot)
    held = all(one["step"]["default"] <= one["step"]["reference"] + ALLOWED for one in found)
    raise SystemExit(0 if held else 1)


if __name__ == "__main__":
    import sys

    sys.path.insert(0, str(Path(__file__).parents[1]))  # helpers of the tests
    main()
