"""The SH fit of synthetic samples: time per texel, compilation, and error of the spectra.

Blocks of neighbouring texels have cameras of their own, and see the same 40 % of them; the
samples of both right-hand sides are made from these in the kernel, as the pipeline does, so
that what is timed is the fit and not the memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from oracle import frequency

from studies.clock import compile_record, measure, per_texel
from svu_mi.bench.fresh import in_new_process
from svu_mi.bench.text import Bar
from svu_mi.frequency import fit_lanes, power_lanes, solver_groups
from svu_mi.frequency.system import System
from svu_mi.interop import owned
from svu_mi.local import scatter_rows
from svu_mi.options import Preset, preset

SIDES = 6  # three colours of outgoing, three of incoming radiance
BLOCK = 256  # texels
DISTANCE = 4.0  # of the cameras; texels are on a unit sphere
CHECKED = 100  # texels that are compared with double precision
SEED = 31337
ERROR_BAR, COMPILE_BAR_S = 1e-4, 8.0


@dataclass(frozen=True)
class Case:
    """One fit.

    Attributes:
        views: V.
        visible: how many of them a texel sees.
        limit: bar of the time per texel in us, None without one.
        base: name of the preset; lambda, R_00 and l* are its own.
    """

    views: int
    visible: int
    limit: float | None
    base: str

    @property
    def label(self) -> str:
        """For tables."""
        return f"{self.base}, {self.visible} of {self.views} views"

    @property
    def switches(self) -> Preset:
        """Its preset, with three colours."""
        named = preset(self.base)
        return named if named.colors == 3 else replace(named, channels="joint")


SIZES: tuple[tuple[int, int, float | None], ...] = (
    (60, 24, 1.5), (100, 40, 3.3), (240, 110, None),
)  # fmt: skip
SLOW = 8  # where no bar is: the primal needs no more texels than this part
CASES = tuple(
    Case(views, visible, limit, base)
    for base in ("default", "paper")
    for views, visible, limit in SIZES
)


def measure_fit(texels: int, repeats: int, cases: tuple[Case, ...] = CASES) -> dict[str, Any]:
    """Measure every case.

    Args:
        texels: number of them; where there is no bar, an eighth.
        repeats: warm runs.
        cases: what to fit.

    Returns:
        ``rows``: one per case with its ``label``, ``texels``, ``microseconds`` per texel in
        kernels and ``wall_microseconds`` by the clock, ``operations``, ``launched`` kernels,
        ``compile`` and ``error``: the largest of a degree's power, relative to the largest
        degree of its texel and channel; ``compile_seconds`` of all; and ``bars``.
    """
    compiled = in_new_process(compile_fits, cases=[asdict(case) for case in cases])
    rows = [{**_measured(case, texels, repeats), "compile": compiled[case.label]}
            for case in cases]  # fmt: skip
    seconds = sum(row["compile"]["seconds"] for row in rows)
    bars = [bar.record() for bar in _bars(cases, rows, seconds)]
    return {"rows": rows, "compile_seconds": seconds, "bars": bars}


def compile_fits(cases: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what compiling the kernels of every case costs, by label; for a new process."""
    result = {}
    for case in (Case(**fields) for fields in cases):
        blocks = Blocks.draw(case, BLOCK)
        result[case.label] = compile_record(partial(fit, blocks, case.switches))
    return result


def _measured(case: Case, texels: int, repeats: int) -> dict[str, Any]:
    if case.limit is None:
        texels = -(-texels // SLOW)
    blocks = Blocks.draw(case, texels)
    timed = measure(partial(fit, blocks, case.switches), repeats)
    outgoing, incoming = fit(blocks, case.switches)
    power = np.concatenate([np.array(outgoing), np.array(incoming)], axis=-1)
    return {
        **per_texel(case.label, timed, texels, "microseconds"),
        "error": largest_error(power, blocks, case.switches),
    }


def _bars(cases: tuple[Case, ...], rows: list[dict[str, Any]], seconds: float) -> list[Bar]:
    times = [
        Bar(f"SH fit, {case.label}: time per texel", row["microseconds"]["median"],
            case.limit, "us")
        for case, row in zip(cases, rows, strict=True)
        if case.limit is not None
    ]  # fmt: skip
    worst = max(rows, key=lambda row: row["error"])
    return [
        *times,
        Bar(f"SH fit, worst case ({worst['label']}): error", worst["error"], ERROR_BAR, ""),
        Bar("SH fit, all kernels: compilation", seconds, COMPILE_BAR_S, "s"),
    ]


# --- the fit and its truth ------------------------------------------------------------------


@dataclass(frozen=True)
class Blocks:
    """Samples of T texels in blocks of BLOCK; each block has V cameras.

    Attributes:
        texels: T.
        views: V, an opaque UInt32.
        normals: (blocks,) Vector3f.
        cameras: (blocks * V,) Point3f, above their block's horizon.
        seen: (blocks * V,) Bool, of the whole block.
        radiance: (blocks * V * 6,) Float.
        coverage: (T,) UInt32, number of views that see each texel.
    """

    texels: int
    views: Any
    normals: Any
    cameras: Any
    seen: Any
    radiance: Any
    coverage: Any

    @classmethod
    def draw(cls, case: Case, texels: int) -> Blocks:
        """Place cameras at random, and draw noisy positive radiance."""
        rng = np.random.default_rng(SEED)
        count = -(-texels // BLOCK)
        normal = _unit(rng.normal(size=(count, 1, 3)))
        direction = _unit(rng.normal(size=(count, case.views, 3)))
        height = (direction * normal).sum(axis=-1, keepdims=True)
        # Mirrored above the horizon, and a little further up: no texel of a block loses one.
        direction = _unit(direction + (np.abs(height) - height + 0.2) * normal)
        order = rng.random((count, case.views)).argsort(axis=1)
        values = np.exp(0.7 * rng.normal(size=(count, case.views, SIDES)))
        return cls(
            texels=texels,
            views=dr.opaque(mi.UInt32, case.views),
            normals=owned(mi.Vector3f, normal[:, 0].T),
            cameras=owned(mi.Point3f, DISTANCE * direction.reshape(-1, 3).T),
            seen=owned(mi.Bool, (order < case.visible).ravel()),
            radiance=owned(mi.Float, values.ravel().astype(np.float32)),
            coverage=owned(mi.UInt32, np.full(texels, case.visible, np.uint32)),
        )

    def sampler(self, texel: Any) -> Callable[[Any], tuple[Any, Any, list[Any]]]:
        """Return what ``fit_lanes`` asks: the sample of a view, for these texels."""
        block = texel // BLOCK
        normal = dr.gather(mi.Vector3f, self.normals, block)
        turn = mi.Float(texel - block * BLOCK)
        position = normal + 0.05 * mi.Vector3f(dr.sin(turn), dr.cos(turn), dr.sin(2 * turn))

        def sample(view: Any) -> tuple[Any, Any, list[Any]]:
            place = block * self.views + view
            seen = dr.gather(mi.Bool, self.seen, place)
            camera = dr.gather(mi.Point3f, self.cameras, place)
            direction = mi.Vector3f(dr.normalize(camera - position))
            # Texels of a block differ in what they see, not in who sees them.
            gain = 1 + 0.3 * direction.x
            values = [
                gain * dr.gather(mi.Float, self.radiance, place * SIDES + side, seen)
                for side in range(SIDES)
            ]
            return direction, dr.select(seen, dr.dot(normal, direction), 0), values

        return sample


def fit(blocks: Blocks, switches: Preset) -> tuple[Any, Any]:
    """Fit and take power spectra as ``frequency.gather.fit_spectra`` does: outgoing, incoming."""
    colors = switches.colors
    shape = (blocks.texels, switches.degree + 1, colors)
    outgoing, incoming = dr.zeros(mi.TensorXf, shape), dr.zeros(mi.TensorXf, shape)
    dr.eval(outgoing, incoming)
    system = System.of(
        switches.degree, 2 * colors, switches.regularizer, switches.penalize_constant
    )
    for group in solver_groups(blocks.coverage, switches.degree):
        sample = blocks.sampler(group.selection)
        coefficients = fit_lanes(sample, blocks.views, system, group.capacity)
        power = power_lanes(coefficients)
        for spectra, channels in ((outgoing, slice(colors)), (incoming, slice(colors, None))):
            scatter_rows(spectra.array, [row[channels] for row in power], group.selection)
        dr.eval(outgoing, incoming)
    return outgoing, incoming


def largest_error(power: np.ndarray, blocks: Blocks, switches: Preset) -> float:
    """Compare spectra (T, l* + 1, 6) of some texels with double precision."""
    some = np.random.default_rng(SEED).choice(
        blocks.texels, min(CHECKED, blocks.texels), replace=False
    )
    views = int(blocks.views[0])
    texel = owned(mi.UInt32, some.repeat(views).astype(np.uint32))
    view = owned(mi.UInt32, np.tile(np.arange(views, dtype=np.uint32), len(some)))
    direction, weight, values = blocks.sampler(texel)(view)
    fitted = frequency.fit(
        np.array(direction).T.reshape(len(some), views, 3),
        np.array(weight).reshape(len(some), views),
        np.stack([np.array(v) for v in values], -1).reshape(len(some), views, SIDES),
        switches.degree,
        switches.regularizer,
        switches.penalize_constant,
    )
    truth = frequency.power(fitted)
    wrong = np.abs(power[some] - truth) / truth.max(axis=1, keepdims=True)
    return float(wrong.max())


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
