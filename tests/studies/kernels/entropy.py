"""Entropy of a posterior: time per texel, what it costs to compile, and how exact it is.

Only the hot path is timed: all input is on the device, and nothing but entropies is returned.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from oracle import batched
from oracle.posterior import F0

from studies.clock import compile_record, measure, per_texel
from svu_mi.bench.fresh import in_new_process
from svu_mi.bench.text import Bar
from svu_mi.fours import padded
from svu_mi.interop import owned
from svu_mi.options import Preset, preset
from svu_mi.posterior import (
    ParameterGrid,
    PrincipledGrid,
    angular_posterior,
    spectrum_posterior,
)
from svu_mi.reflection.lobes import mean_albedo
from svu_mi.statistics.factors import FLOOR, PAIRS, Factors, stride

DEGREE = 6
CHECKED = 2000  # texels that are compared with double precision
SEED = 20220811
TIME_BAR_NS, COMPILE_BAR_S = 80.0, 3.0
# Angular statistics, hence energies, are in single precision; those of spectra in double.
ERROR_BARS = {"spectrum": 1e-6, "angular": 5e-6}


@dataclass(frozen=True)
class Case:
    """A posterior whose entropy is measured.

    Attributes:
        label: for tables.
        switches: its preset.
        grid: its nodes.
    """

    label: str
    switches: Any
    grid: Any

    @property
    def method(self) -> str:
        """``angular`` or ``spectrum``."""
        return "spectrum" if isinstance(self.switches, Preset) else "angular"


def _cases() -> tuple[Case, ...]:
    paper = preset("paper")
    joint = preset("default", channels="joint", parameters="specular")
    cube = PrincipledGrid(8, 8, 8)
    return (
        *(Case(f"spectrum paper, {n} x {n}", paper, ParameterGrid(n, n)) for n in (8, 16, 32)),
        *(Case(f"spectrum joint, {n} x {n}", joint, ParameterGrid(n, n)) for n in (8, 32)),
        Case("spectrum grey, 8 x 8 x 8", preset("default"), cube),
        Case("spectrum joint, 8 x 8 x 8", preset("default", channels="joint"), cube),
        Case("angular fixed, 8 x 8 x 8", preset("fixed", method="angular"), cube),
    )


CASES = _cases()


def measure_entropy(texels: int, repeats: int) -> dict[str, Any]:
    """Measure every case.

    Args:
        texels: number of them.
        repeats: warm runs.

    Returns:
        ``rows``: one per case with its ``label``, ``texels``, ``nanoseconds`` per texel in
        kernels and ``wall_nanoseconds`` by the clock (see ``clock.spread``), ``operations``,
        ``launched`` kernels, ``compile`` (see ``timing.compile_record``) and ``error``, the
        largest of the checked texels; and ``bars``.
    """
    compiled = in_new_process(compile_entropy, texels=1024)
    rows = [{**_measured(case, texels, repeats), "compile": compiled[case.label]}
            for case in CASES]  # fmt: skip
    return {"rows": rows, "bars": [bar.record() for bar in _bars(rows)]}


def compile_entropy(texels: int) -> dict[str, Any]:
    """Return what compiling the kernels of every case costs, by label; for a new process."""
    return {
        case.label: compile_record(hot_path(problem_of(case, texels).posterior)) for case in CASES
    }


def hot_path(posterior: Any) -> Callable[[], Any]:
    """Return a function that computes the entropy anew each time it is called."""
    return lambda: replace(posterior).entropy()  # a posterior remembers its own


def _measured(case: Case, texels: int, repeats: int) -> dict[str, Any]:
    problem = problem_of(case, texels)
    entropy = hot_path(problem.posterior)
    timed = measure(entropy, repeats)
    return {
        **per_texel(case.label, timed, texels, "nanoseconds"),
        "error": largest_error(np.array(entropy()), problem),
    }


def largest_error(entropy: np.ndarray, problem: Problem) -> float:
    """Compare the entropies (T,) of a problem's checked texels with double precision."""
    wrong = np.abs(entropy[problem.checked].astype(np.float64) - problem.truth())
    return float(wrong.max())  # NaN if there is one


def _bars(rows: list[dict[str, Any]]) -> list[Bar]:
    found = {row["label"]: row for row in rows}
    small, large = found[CASES[0].label], found[CASES[2].label]
    worst = {
        method: float(np.max([found[c.label]["error"] for c in CASES if c.method == method]))
        for method in ERROR_BARS
    }
    return [
        Bar(f"entropy, {small['label']}: time per texel", small["nanoseconds"]["median"],
            TIME_BAR_NS, "ns"),
        *(Bar(f"entropy, {method}: largest error of all cases", worst[method], limit, "")
          for method, limit in ERROR_BARS.items()),
        Bar(f"entropy, {large['label']}: compilation", large["compile"]["seconds"],
            COMPILE_BAR_S, "s"),
    ]  # fmt: skip


# --- problems and their truth ---------------------------------------------------------------


@dataclass(frozen=True)
class Problem:
    """A posterior, and what its entropy should be.

    Attributes:
        posterior: of T texels.
        checked: (n,) indices of some.
        truth: returns their entropies (n,), in double precision.
    """

    posterior: Any
    checked: np.ndarray
    truth: Callable[[], np.ndarray]


def problem_of(case: Case, texels: int) -> Problem:
    """Draw texels for a case: dark and bright ones, so that some posteriors are sharp."""
    rng = np.random.default_rng(SEED)
    checked = rng.choice(texels, min(CHECKED, texels), replace=False)
    make = _of_spectra if case.method == "spectrum" else _of_statistics
    return make(rng, case, texels, checked)


def _of_spectra(rng: np.random.Generator, case: Case, texels: int, checked: np.ndarray) -> Problem:
    """Light, and what materials of the principled model make of it, with 5 % of noise."""
    channels, l = case.switches.colors, np.arange(DEGREE + 1)[:, None]
    S_L = rng.exponential(size=(texels, DEGREE + 1, channels)) * 10 * np.exp(-0.5 * l)
    S_L *= 10 ** rng.uniform(-1.5, 1.5, (texels, 1, 1))
    alpha, metallic = rng.random((texels, 1, 1)) ** 2, rng.random((texels, 1, 1))
    color = rng.random((texels, 1, channels))
    R0 = F0 * (1 - metallic) + metallic * color
    # Constant light of radiance 1 has S(0) = 4 pi and irradiance pi; some of it is hidden.
    E = np.sqrt(S_L[:, :1] * math.pi / 4) * rng.uniform(0.3, 1, (texels, 1, channels))
    S_B = S_L * R0**2 * np.exp(-2 * (alpha * l) ** 2)
    S_B[:, :1] = ((1 - metallic) * color * 2 * E / math.sqrt(math.pi) + np.sqrt(S_B[:, :1])) ** 2
    S_B *= np.exp(0.05 * rng.normal(size=S_B.shape))
    S_L, S_B, E = (values.astype(np.float32) for values in (S_L, S_B, E[:, 0]))
    principled = isinstance(case.grid, PrincipledGrid)
    posterior = spectrum_posterior(
        mi.TensorXf(S_L), mi.TensorXf(S_B), case.grid, preset=case.switches,
        irradiance=mi.TensorXf(E) if principled else None,
    )  # fmt: skip
    relative = case.switches.noise == "relative"
    unit = float(S_B.astype(np.float64).sum(axis=1).mean()) if relative else 1.0
    some = [values[checked].astype(np.float64) for values in (S_L, S_B, E)]
    return Problem(posterior, checked, lambda: _spectrum_truth(case, posterior.axes, some, unit))


def _spectrum_truth(
    case: Case, axes: dict[str, np.ndarray], given: list[np.ndarray], unit: float
) -> np.ndarray:
    """Entropy (T,) from Eq. 3 to 5, 7 and 11.

    Args:
        case: the posterior.
        axes: its nodes.
        given: S_L and S_B (T, L + 1, C), E (T, C).
        unit: power that sigma is a part of.
    """
    (S_L, S_B, E), switches, roughness = given, case.switches, axes["roughness"]
    alpha = np.maximum(roughness**2, 1e-3 if switches.bounded_alpha else 0)
    decay = np.exp(-2 * (alpha[:, None] * np.arange(1, DEGREE + 1)) ** 2)
    if isinstance(case.grid, ParameterGrid):
        x = batched.spectrum_energy(S_L, S_B, switches.sigma * unit, decay, axes["specular"])
    else:
        albedo = np.ones(len(alpha))
        if switches.albedo:
            albedo = mean_albedo(alpha)  # given, like the light: its truth is another test's
        m, c = axes["metallic"][:, None], axes["base_color"]
        R0, Kd = (F0 * (1 - m) + m * c)[:, :, None], ((1 - m) * c)[:, :, None]
        x = np.concatenate([
            batched.spectrum_energy(
                S_L, S_B, switches.sigma * unit, np.tile(a**2 * e, (len(m), 1)), R0[..., 0]
            )
            + batched.constant_energy(
                np.sqrt(S_B[:, None, None, 0]), Kd * 2 * E[:, None, None] / math.sqrt(math.pi),
                R0 * a * np.sqrt(S_L[:, None, None, 0]), switches.constant_sigma * math.sqrt(unit),
            )
            for a, e in zip(albedo, decay, strict=True)
        ], axis=1)  # fmt: skip
    if switches.channels == "joint":
        return batched.joint_entropy(x)
    return batched.shared_entropy(x.sum(axis=-1))


def _of_statistics(
    rng: np.random.Generator, case: Case, texels: int, checked: np.ndarray
) -> Problem:
    """The factors of every roughness, as ``Statistics`` leave them; sigma counts as 1."""
    shape = case.grid.roughness, texels
    brightness = 10 ** rng.uniform(-1.5, 1, texels)
    u = dict.fromkeys(PAIRS, np.zeros(shape))
    for column, smallest, largest in ((0, 0.3, 1), (1, 0.01, 0.5), (2, 0.01, 0.3)):
        u[column, column] = rng.uniform(smallest, largest, shape)
    u[0, 1], u[0, 2], u[1, 2] = rng.uniform(0, 1, shape), *rng.uniform(-0.3, 0.3, (2, *shape))
    c, m = rng.random((2, texels))
    for row in range(3):
        model = sum(u[row, k] * x for k, x in enumerate(((1 - m) * c, m * c, m)) if k >= row)
        u[row, 3] = 0.05 * rng.normal(size=shape) - model
    u[3, 3] = rng.uniform(0, 0.3, shape)
    fields = brightness * np.stack([u[pair] for pair in PAIRS], axis=1)
    fields[:, FLOOR] **= 2
    fields = fields.astype(np.float32)
    views = np.full((1, texels), 20)
    rows = np.zeros((texels, stride(case.grid.roughness, 1)), np.float32)
    of_levels = rows[:, : -padded(2)].reshape(texels, case.grid.roughness, -1)
    of_levels[..., : len(PAIRS)] = np.moveaxis(fields, 2, 0)
    rows[:, -padded(2) + 1] = views
    factors = Factors(
        values=owned(mi.Float, rows.ravel()), views=owned(mi.UInt32, views[0]),
        texel=dr.arange(mi.UInt32, texels), roughness=case.grid.roughness_nodes, channels=1,
    )  # fmt: skip
    posterior = angular_posterior(factors, case.grid, 1.0, case.switches)
    some = fields[:, :, checked].astype(np.float64)
    axes, sigma = posterior.axes, case.switches.sigma
    return Problem(posterior, checked, lambda: _angular_truth(axes, some, sigma))


def _angular_truth(axes: dict[str, np.ndarray], fields: np.ndarray, sigma: float) -> np.ndarray:
    """Entropy (T,) of |U (c (1 - m), c m, m, 1)|^2, fields (levels, 10, T)."""
    # (levels, 10, T) -> 10 x (T, levels, 1, 1), for cells (metallic, base colour).
    u = dict(zip(PAIRS, fields.transpose(1, 2, 0)[..., None, None], strict=True))
    m, c = axes["metallic"][:, None], axes["base_color"]
    x = c * (1 - m), c * m, m, 1
    rows = [sum(u[row, k] * x[k] for k in range(row, 4)) for row in range(3)]
    d = sum(row**2 for row in rows) + u[3, 3]
    return batched.shared_entropy(d / (2 * sigma**2))
