"""``svu bench poses``: do refined poses bring back the textures that wrong poses cost?

Cameras of each case are moved at random by three angles, and translated by the same part of their
distance. Textures are the posterior means of ``default``.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Measurement, Record
from svu_mi.bench.markdown import Bar, Column, digits, tabulate
from svu_mi.bench.spoiled_captures import without_masks
from svu_mi.bench.study import Selection, Study
from svu_mi.calibration.poses.pose_equations import moved_sensor
from svu_mi.calibration.poses.refine_poses import camera_distances, moved_pixels, refine_poses
from svu_mi.capture.capture import Capture
from svu_mi.capture.scene import to_world
from svu_mi.evaluation.ground_truth import ground_truth
from svu_mi.geometry.texels import texels
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate

SIZES: dict[str, Any] = {"views": 60, "film": 256, "spp": 32}
QUICK: dict[str, Any] = {"views": 16, "film": 64, "spp": 8}
TEXELS, QUICK_TEXELS = 128, 32  # per side
ANGLES = (0.05, 0.2, 0.5)  # degrees rms
SOUND, FEW = "exact", 3  # photographs of a compared texel
BARE = 0.2  # the angle that is also refined without masks


def shaken(capture: Capture, degrees: float, seed: int = 5) -> Capture:
    """Move cameras at random: rotations of ``degrees`` rms, translations of the same effect."""
    random = np.random.default_rng(seed)
    motions = np.radians(degrees) / np.sqrt(3) * random.normal(size=(capture.count, 6))
    moved = map(moved_sensor, capture.sensors, motions, camera_distances(capture))
    return replace(capture, sensors=tuple(moved))


def _row(angle: float) -> Measurement:
    return Measurement(f"{angle} degrees", lambda self: self.refined(angle))


@dataclass(frozen=True)
class PoseCase(CaseSubject):
    """A case whose cameras are moved and refined."""

    rows = (
        Measurement(SOUND, lambda self: self.refined(0.0)),
        *(_row(angle) for angle in ANGLES),
        Measurement(f"{BARE} degrees, no masks", lambda self: self.refined(BARE, masks=False)),
    )

    @cached_property
    def capture(self) -> Capture:
        """Photographs of the case."""
        return self.bench.capture(self.case, "poses", **(QUICK if self.bench.quick else SIZES))

    def refined(self, degrees: float, *, masks: bool = True) -> Record:
        """Return errors of poses and PSNR of textures, before and after."""
        wrong = shaken(self.capture, degrees)
        start = time.perf_counter()
        after = refine_poses(wrong if masks else without_masks(wrong))
        seconds = time.perf_counter() - start
        return {
            "seconds": seconds, **self._errors(after.capture, ""), **self._psnr(after.capture, ""),
            **self._errors(wrong, " before"), **self._psnr(wrong, " before"),
        }  # fmt: skip

    def _errors(self, found: Capture, suffix: str) -> Record:
        """Return rms errors in pixels, degrees and percent of the distance."""
        own = [to_world(sensor) for sensor in self.capture.sensors]
        other = [to_world(sensor) for sensor in found.sensors]
        turns = [Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude()
                 for a, b in zip(own, other, strict=True)]  # fmt: skip
        steps = [np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(own, other, strict=True)]
        values = {
            "pixels": moved_pixels(self.capture, found), "degrees": np.degrees(turns),
            "percent": 100 * np.array(steps) / camera_distances(self.capture),
        }  # fmt: skip
        return {name + suffix: float(np.sqrt(np.mean(np.square(x)))) for name, x in values.items()}

    def _psnr(self, capture: Capture, suffix: str) -> Record:
        """Return the PSNR of posterior means by parameter."""
        grid = texels(capture.mesh, QUICK_TEXELS if self.bench.quick else TEXELS)
        found, truth = estimate(capture, grid), ground_truth(capture, grid)
        known = np.array(found.coverage) >= FEW
        return {
            name + suffix: float(-10 * np.log10(np.mean(np.square(
                (np.array(found.posterior.mean(name)) - truth[name])[known]
            ))))
            for name in NAMES
        }  # fmt: skip


def _lines(record: Record) -> list[Record]:
    return [{"case": cell["cell"], "row": label, **row}
            for cell in record["cells"] for label, row in cell["rows"].items()]  # fmt: skip


def _column(key: str) -> Column:
    return Column(key, lambda line: line.get(key), digits(2))


def _both(name: str) -> list[Column]:
    return [_column(f"{name} before"), _column(name)]


SHOWN: Sequence[Column] = (
    Column("case", lambda line: line["case"]), Column("cameras", lambda line: line["row"]),
    *_both("pixels"), *_both("degrees"), *_both("percent"),
    *(column for name in NAMES for column in _both(name)),
    Column("seconds", lambda line: line.get("seconds"), digits(0)),
)  # fmt: skip


def bars(record: Record) -> list[Bar]:
    """Return the bars of a record of ``svu bench poses``."""
    lost, sound, worst = [], [], {"degrees": 0.0, "percent": 0.0}
    for cell in record["cells"]:
        exact = cell["rows"].get(SOUND)
        for label, row in cell["rows"].items():
            if label == SOUND:
                sound.append(row["pixels"])
            elif exact is not None and "masks" not in label:
                lost += [exact[f"{name} before"] - row[name] for name in NAMES]
                worst = {name: max(value, row[name]) for name, value in worst.items()}
    return [
        Bar("motion of sound cameras, most, pixels", max(sound, default=np.nan), 0.1),
        Bar("textures with refined poses, dB below exact ones, most",
            max(lost, default=np.nan), 0.5),
        Bar("refined poses, degrees, most", worst["degrees"], 0.05),
        Bar("refined poses, percent of the distance, most", worst["percent"], 0.1),
    ]  # fmt: skip


def experiment(bench: BenchRun, selection: Selection) -> Experiment:
    """Return the experiment: cases with moved cameras."""
    return Experiment("poses", [PoseCase(bench, case) for case in selection.cases])


STUDY = Study(title="Refined poses", experiment=experiment, bars=bars, own_sizes=True,
              tables=lambda record: [tabulate(SHOWN, _lines(record))])  # fmt: skip
