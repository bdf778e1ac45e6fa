"""Compare the results of two versions of svu_mi on 12 cases and a real capture.

    python tests/support/same_answers.py render CAPTURES        # once, by either version
    python tests/support/same_answers.py measure CAPTURES before.npz [--real CAPTURE]
    python tests/support/same_answers.py compare before.npz after.npz

``measure`` uses the svu_mi of the folder that it runs in, and only public names of it. Captures are
rendered once and read by both versions. ``compare`` prints the largest difference per answer, in
parts of its range, and exits with 1 if one exceeds 1e-5 or a choice differs. A light that was found
is the end of a long iteration in float32 sums whose order varies: ``measure`` twice with one
version shows how far that alone takes it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path.cwd()))

import svu_mi as svu  # noqa: E402

OBJECTS, LIGHTS = ("vase", "knot", "spheres"), ("clear", "overcast", "studio", "window")
FILM, VIEWS, SPP, RESOLUTION = (72, 56), 16, 16, (80, 64)
PARAMETERS = ("roughness", "metallic", "base_color")
TOLERANCE = 1e-5


def render(folder: Path) -> None:
    """Render the photographs of all cells, except for those that are there."""
    from svu_mi import scenes

    for shape in OBJECTS:
        for light in LIGHTS:
            target = folder / f"{shape}-{light}"
            if not target.exists():
                svu.render_capture(
                    scenes.path(shape), spp=SPP, seed=7, folder=target, views=VIEWS,
                    resolution=FILM, defines={"light": light, "max_depth": "2"},
                )  # fmt: skip
            print("rendered", target.name, flush=True)


def estimates(capture: Any, texels: Any) -> Iterator[tuple[str, Any]]:
    """Yield entropy, moments and intervals of the presets."""
    rows: Any = (("angular", "default"), ("angular", "fast"), ("spectrum", "paper"))
    for method, preset in rows:
        estimate = svu.estimate(capture, texels, method, preset)
        label = f"{method} {preset}"
        yield f"{label}: entropy", estimate.image("entropy")
        yield f"{label}: coverage", estimate.image("coverage")
        for name in PARAMETERS if method == "angular" else ("roughness",):
            ends = ("low", "high") if method == "angular" else ()
            for what in ("mean", "sd", *ends):
                yield f"{label}: {name} {what}", estimate.image(f"{name}_{what}")


def textures(capture: Any, texels: Any) -> Iterator[tuple[str, Any]]:
    """Yield textures by the SH model, with and without sharing, and how sure they are."""
    for sharing in (False, True):
        recovery = svu.recover(capture, texels, "sh", sharing=sharing)
        label = "sharing" if sharing else "sh"
        for name in PARAMETERS:
            yield f"{label}: {name}", recovery.image(name)
        if not sharing:
            field = svu.texture_field(recovery)
            for name in PARAMETERS:
                yield f"texture field: {name} sd", field.sd(name)


def choices(capture: Any, texels: Any) -> Iterator[tuple[str, Any]]:
    """Yield the candidates that guidance chooses, by two strategies."""
    estimate = svu.estimate(capture, texels)
    for strategy in ("entropy", "error"):
        guidance = svu.next_best_view(estimate, count=3, strategy=strategy, texels=512)
        names = [proposal.name for proposal in guidance.proposals]
        yield f"choices: {strategy}", np.array(names)
        yield f"guidance {strategy}: gains", guidance.scores


def light(capture: Any, texels: Any, *, gains: bool) -> Iterator[tuple[str, Any]]:
    """Yield the light found in the photographs, and their gains."""
    options = svu.LightOptions(texels=200, depths=((256, 4),), gains=gains)
    estimated = svu.estimate_light(capture, texels, options)
    yield "light: logarithm", estimated.logarithm
    yield "light: sd", estimated.cell_sd
    yield "light: widening", np.array([estimated.widening])
    if estimated.gains is not None:
        yield "light: gains", estimated.gains.factor
    under = svu.estimate(svu.with_light(capture, estimated), texels)
    yield "under found light: entropy", under.image("entropy")
    yield "under found light: roughness mean", under.image("roughness_mean")


def answers(capture: Any) -> Iterator[tuple[str, Any]]:
    """Yield all answers of a capture whose light is known."""
    texels = svu.texels(capture.mesh, RESOLUTION)
    yield from estimates(capture, texels)
    yield from textures(capture, texels)
    yield from choices(capture, texels)
    yield from light(capture, texels, gains=False)
    yield "gains under known light", svu.estimate_gains(capture, texels).factor


def measure(folder: Path, target: Path, real: Path | None) -> None:
    """Compute all answers and keep them in an npz file."""
    print("measuring", svu.__file__, flush=True)
    results: dict[str, Any] = {}
    for path in sorted(folder.iterdir()):
        for name, values in answers(svu.load_capture(path)):
            results[f"{path.name}|{name}"] = np.asarray(values)
        print("measured", path.name, flush=True)
    if real is not None:
        capture = svu.load_capture(real, light="optional")
        for name, values in light(capture, svu.texels(capture.mesh, RESOLUTION), gains=True):
            results[f"real|{name}"] = np.asarray(values)
    np.savez_compressed(target, **results)


def difference(before: np.ndarray, after: np.ndarray) -> float:
    """Return the largest difference in parts of the range of ``before``; infinite if choices,
    shapes or missing values differ."""
    if before.shape != after.shape or before.dtype.kind in "US":
        return 0.0 if np.array_equal(before, after) else np.inf
    known = np.isfinite(before)
    if not np.array_equal(known, np.isfinite(after)):
        return np.inf
    if not known.any():
        return 0.0
    scale = max(float(np.abs(before[known]).max()), 1e-12)
    return float(np.abs(before[known].astype(float) - after[known]).max() / scale)


def compare(before: Path, after: Path) -> int:
    """Print the largest difference of each answer over all captures."""
    left, right = np.load(before), np.load(after)
    if set(left.files) != set(right.files):
        print("answers are missing:", sorted(set(left.files) ^ set(right.files)))
        return 1
    worst: dict[str, tuple[float, str]] = {}
    for key in left.files:
        cell, name = key.split("|")
        worst[name] = max(worst.get(name, (-1.0, "")), (difference(left[key], right[key]), cell))
    for name, (value, cell) in worst.items():
        mark = "" if value <= TOLERANCE else "  <-- differs"
        print(f"{name:45} {value:9.2e}  {cell}{mark}")
    return int(any(value > TOLERANCE for value, _ in worst.values()))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("render").add_argument("captures", type=Path)
    measuring = commands.add_parser("measure")
    measuring.add_argument("captures", type=Path)
    measuring.add_argument("target", type=Path)
    measuring.add_argument("--real", type=Path)
    comparing = commands.add_parser("compare")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    given = parser.parse_args()
    if given.command == "compare":
        return compare(given.before, given.after)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    if given.command == "render":
        render(given.captures)
    else:
        measure(given.captures, given.target, given.real)
    return 0


if __name__ == "__main__":
    sys.exit(main())
