"""``svu bench reflected``: textures under light of tables, of the object itself, and of lamps.

Posterior means and 90 % intervals of the preset ``default``, compared with the true textures, in
photographs of direct light, of all bounces, on tables (from above), under four area lights, and
with a flash only.
The radiance of the model is compared with path tracing (``radiance_error``), and means of some
texels with those of path-traced posteriors, which show what the photographs determine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import repeat
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.bench.captures import capture_in_memory
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Measurement, Record
from svu_mi.bench.markdown import Column, digits, tabulate
from svu_mi.bench.posterior_scores import JUDGED, posterior_figures
from svu_mi.bench.radiance_error import radiance_error
from svu_mi.bench.scene_light import learned_posterior, scene_light_posteriors
from svu_mi.bench.spoiled_captures import box_of, photographed, with_table
from svu_mi.bench.study import Selection, Study
from svu_mi.capture.capture import Capture, Flash
from svu_mi.capture.mesh import arrays
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.capture.surroundings import DEPTH, DIRECT
from svu_mi.core.arrays import evenly_spaced
from svu_mi.evaluation.psnr import psnr
from svu_mi.geometry.texel_materials import parameters_at
from svu_mi.geometry.texels import texels
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate
from svu_mi.posterior.posterior import Posterior
from svu_mi.presets import preset

# With 32 samples, pixels had 6 to 18 % noise (median), more on tables, which decided there.
SIZES: dict[str, Any] = {"views": 24, "film": 192, "spp": 128}
QUICK: dict[str, Any] = {"views": 16, "film": 48, "spp": 4}
TEXELS, QUICK_TEXELS = 96, 32  # per side
QUICK_PATHS = 50, 16  # pairs, and square root of the paths of each half
TRACED, QUICK_TRACED = (200, 128), (12, 8)  # path-traced texels, and samples of each lobe
GREY, BLACK = (0.5, 0.5, 0.5), (0.0, 0.0, 0.0)
# Directions of four square area lights and their radiance, three radii from the object.
LIGHTS = (((2, 2.5, 2), (10, 9, 8)), ((-2, 2, 1.5), (6, 7, 9)),
          ((0.5, -2.5, 2), (5, 5, 5)), ((-0.5, 1, -3), (8, 8, 8)))  # fmt: skip
AWAY = 3.0
FLASHED = {"views": 60, "film": 256, "spp": 32}  # more photographs, as each has one lamp
BESIDE = 0.04  # place of the flash, right of and above the camera, in diagonals of the object


@dataclass(frozen=True)
class ReflectedCase(CaseSubject):
    """A case that is photographed under other light."""

    @property
    def rows(self) -> tuple[Measurement, ...]:
        return tuple(_row(name, made) for name, made in ROWS.items())

    @property
    def photographs(self) -> dict[str, Any]:
        """Number and size of photographs, and their samples per pixel."""
        return QUICK if self.bench.quick else SIZES

    @cached_property
    def direct(self) -> Capture:
        """Photographs of direct light of the environment."""
        return self.bench.capture(self.case, "reflected", **self.photographs)

    @property
    def bounced(self) -> Capture:
        """Photographs of all light of the environment."""
        defines = {**self.case.defines, "max_depth": str(DEPTH)}
        case = replace(self.case, defines=defines)
        return self.bench.capture(case, "reflected-bounces", **self.photographs)

    def on_known_table(self, color: tuple[float, float, float]) -> Capture:
        """Photographs on a table that is in the scene."""
        capture = with_table(self.direct, color)
        return photographed(capture, repeat(capture.scene), self.photographs["spp"])

    @cached_property
    def on_grey(self) -> Capture:
        """Photographs on a grey table that is in the scene."""
        return self.on_known_table(GREY)

    @property
    def from_above(self) -> Capture:
        """Photographs of direct light, without a table, by the cameras that are above one."""
        capture = replace(with_table(self.direct, BLACK), scene=self.direct.scene)
        return photographed(capture, repeat(capture.scene), self.photographs["spp"], depth=DIRECT)

    @property
    def under_lamps(self) -> Capture:
        """Photographs under four area lights, without the environment."""
        center, size = box_of(arrays(self.direct.shape))
        lamps = []
        for number, (toward, radiance) in enumerate(LIGHTS):
            place = center + AWAY * size / 2 * np.array(toward) / np.linalg.norm(toward)
            to = mi.ScalarTransform4f().look_at(place.tolist(), center.tolist(), [0.1, 1, 0.1])
            light = {"type": "rgb", "value": list(radiance)}
            lamps.append(mi.load_dict({
                "type": "rectangle", "id": f"lamp{number}", "to_world": to.scale(0.2 * size),
                "bsdf": {"type": "diffuse", "reflectance": 0.0},
                "emitter": {"type": "area", "radiance": light},
            }))  # fmt: skip
        direct = mi.load_dict({"type": "path", "max_depth": DIRECT})
        capture = replace(self.direct, scene=make_scene([direct, self.direct.shape, *lamps]))
        return photographed(capture, repeat(capture.scene), self.photographs["spp"], depth=DIRECT)

    @property
    def under_flash(self) -> Capture:
        """Photographs with a lamp on each camera, and no other light."""
        sizes = self.photographs if self.bench.quick else FLASHED
        _, size = box_of(arrays(self.direct.shape))
        place, power = (-BESIDE * size, BESIDE * size, 0.0), (size**2,) * 3
        path = mi.load_dict({"type": "path", "max_depth": DIRECT})
        sensors = sphere_sensors(self.direct.shape, sizes["views"], (sizes["film"],) * 2)
        dark = make_scene([path, self.direct.shape])
        capture = capture_in_memory(dark, self.direct.shape, sensors, ())
        lit = (make_scene([path, self.direct.shape, _lamp_at(x, place, power)]) for x in sensors)
        capture = photographed(capture, lit, sizes["spp"], depth=DIRECT)
        return replace(capture, flash=Flash(place, power))

    def figures(
        self, capture: Capture, *, bounces: bool = False, known: bool = True, depth: int = 0
    ) -> Record:
        """Return the scores of the posterior, and of radiance if the light is ``known``.

        Posteriors are path traced, too, if photographs have paths of a known ``depth``.
        """
        layout = texels(capture.mesh, QUICK_TEXELS if self.bench.quick else TEXELS)
        chosen = preset("default", method="angular", bounces=bounces)
        found = estimate(capture, layout, preset=chosen)
        seen = np.flatnonzero(found.posterior.observed)
        seen = seen[evenly_spaced(len(seen), JUDGED)]
        truth = {name: np.asarray(x) for name, x in parameters_at(capture, layout).items()}
        judged = {name: x[seen] for name, x in truth.items()}
        predicted = found.prediction and found.prediction.r2
        scores = {**posterior_figures(found.posterior, judged, seen), "r2": predicted}
        if found.observed is None:
            return scores
        count, samples = QUICK_TRACED if self.bench.quick else TRACED
        some = np.flatnonzero(found.observed.coverage)
        random = np.random.default_rng(self.bench.sizes.seed)
        some = np.sort(random.choice(some, min(count, len(some)), replace=False))
        true = {name: truth[name][some] for name in NAMES}
        scores |= _psnr_of_means("some", found.posterior, some, true)
        if depth:
            traced = scene_light_posteriors(found.observed, some, ["estimated"], depth, samples)
            posterior = learned_posterior(traced[0])
            scores |= _psnr_of_means("traced", posterior, np.arange(len(some)), true)
        if not known:
            return scores
        sizes = QUICK_PATHS if self.bench.quick else ()
        return {**scores, **radiance_error(found.observed, chosen, *sizes)}


ROWS: dict[str, Callable[[ReflectedCase], Record]] = {
    "direct light": lambda case: case.figures(case.direct, depth=DIRECT),
    "all bounces, ignored": lambda case: case.figures(case.bounced, known=False),
    "all bounces": lambda case: case.figures(case.bounced, bounces=True, depth=DEPTH),
    "direct light, from above": lambda case: case.figures(case.from_above, depth=DIRECT),
    "black table": lambda case: case.figures(case.on_known_table(BLACK), bounces=True, depth=DEPTH),
    "grey table, ignored": lambda case: case.figures(
        replace(case.on_grey, scene=case.direct.scene), known=False
    ),
    "grey table": lambda case: case.figures(case.on_grey, bounces=True, depth=DEPTH),
    "four lamps": lambda case: case.figures(case.under_lamps),
    "flash": lambda case: case.figures(case.under_flash, known=False),
}


def _lamp_at(sensor: Any, place: Sequence[float], power: Sequence[float]) -> Any:
    """Return a point lamp at a place in the frame of a camera."""
    at = to_world(sensor) @ (*place, 1.0)
    intensity = {"type": "rgb", "value": list(power)}
    return mi.load_dict({"type": "point", "position": at[:3].tolist(), "intensity": intensity})


def _psnr_of_means(
    title: str, posterior: Posterior, chosen: np.ndarray, truth: Mapping[str, np.ndarray]
) -> Record:
    """Return the PSNR of the means of ``chosen`` texels, by parameter."""
    means = {name: np.array(posterior.mean(name))[chosen] for name in truth}
    return {f"{title} {name.replace('base_', '')[0]}": psnr(means[name].reshape(true.shape), true)
            for name, true in truth.items()}  # fmt: skip


def _row(name: str, made: Callable[[ReflectedCase], Record]) -> Measurement:
    return Measurement(name, made)


def _lines(record: Record) -> list[Record]:
    """Return the mean of all cases for each row, and the rows of each case."""
    cases = record["cells"]
    lines = []
    for name in ROWS:
        rows = [case["rows"][name] for case in cases if name in case["rows"]]
        if rows:
            mean = {key: _mean([row[key] for row in rows]) for key in rows[0]}
            lines.append({"case": f"**mean of {len(rows)}**", "row": name, **mean})
    return lines + [{"case": case["cell"], "row": name, **row}
                    for case in cases for name, row in case["rows"].items()]  # fmt: skip


def _mean(values: list[float | None]) -> float | None:
    """Return the mean of the numbers; R^2 is None if there are too few photographs."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _number(title: str, key: str, places: int) -> Column:
    return Column(title, lambda line: line.get(key), digits(places))


SHOWN = (
    Column("case", lambda line: line["case"]),
    Column("photographs", lambda line: line["row"]),
    *(_number(f"PSNR {key}", f"psnr {key}", 1) for key in "rmc"),
    *(_number(f"90 % {key}", f"interval {key}", 2) for key in "rmc"),
    _number("R^2", "r2", 2),
    _number("radiance: median error", "radiance median", 3),
    _number("rms", "radiance rms", 3),
    *(_number(f"{TRACED[0]} texels: {key}", f"some {key}", 1) for key in "rmc"),
    *(_number(f"path traced: {key}", f"traced {key}", 1) for key in "rmc"),
)


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    return Experiment("reflected", (ReflectedCase(bench, case) for case in selection.cases), True)


STUDY = Study(title="Reflected light and lamps", experiment=_experiment, own_sizes=True,
              tables=lambda record: [tabulate(SHOWN, _lines(record))])  # fmt: skip
