"""Results that the next command on a capture reads, as arrays of an ``ArrayCache``.

    visibility    about 8 bytes per texel for 60 photographs
    occlusion     128 bytes per texel whose rays are traced (``shared_texels``)
    statistics    1040 bytes per seen texel
    posterior     about 80 bytes per seen texel

Arrays of a file are checked before kernels use them as indices: a forged file must not make them
read elsewhere.
"""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.core.io.array_cache import Arrays
from svu_mi.core.io.schema import Axis, Field, checked
from svu_mi.geometry.bitset import WORD, Bits
from svu_mi.geometry.visibility import Visibility
from svu_mi.light.light_tree import LightTree
from svu_mi.light.light_visibility import LightVisibility
from svu_mi.parameters import NAMES
from svu_mi.posterior.calibrated_fit import CalibratedFit
from svu_mi.posterior.calibrated_kernel import PosteriorSummary
from svu_mi.posterior.calibrated_problem import CalibratedProblem
from svu_mi.posterior.prediction import CAUSES, SIDES, FoldTest, HeldOutPrediction, PartPrediction
from svu_mi.statistics.cholesky_factors import Factors, stride


def pack_visibility(known: Visibility) -> Arrays:
    """Return the arrays of a visibility."""
    clipped = {} if known.clipped is None else {"clipped": known.clipped.words.numpy()}
    return {
        "coverage": known.coverage.numpy(), "total": known.total.numpy(),
        "per_view": known.per_view, "order": known.order.numpy(),
        "bits": known.bits.words.numpy(), **clipped,
    }  # fmt: skip


def restore_visibility(
    arrays: Arrays, views: int, texels: int, *, clipped: bool, dense: bool
) -> Visibility:
    """Return the visibility of texels in views; ``clipped`` if pixels are saturated."""
    schema = {
        "coverage": Field("u4", (texels,)), "total": Field("f8", (texels,)),
        "order": Field("u4", (Axis("order"),), 0, max(views - 1, 0)),
        "per_view": Field("i8", (views,)), "bits": _words(views, texels),
    } | ({"clipped": _words(views, texels)} if clipped else {})  # fmt: skip
    checked(arrays, schema, closed=True)
    order = arrays["order"]
    return Visibility(
        coverage=to_drjit(mi.UInt32, arrays["coverage"]),
        total=to_drjit(mi.Float64, arrays["total"]),
        per_view=arrays["per_view"].copy(), bits=_bits(arrays["bits"], views, texels),
        order=to_drjit(mi.UInt32, order), count=dr.opaque(mi.UInt32, len(order)),
        clipped=_bits(arrays["clipped"], views, texels) if clipped else None, dense=dense,
    )  # fmt: skip


def pack_light_visibility(known: LightVisibility) -> Arrays:
    """Return the arrays of the visibility of light cells."""
    return {"fine": known.fine.words.numpy()}


def restore_light_visibility(arrays: Arrays, tree: LightTree, place: Any) -> LightVisibility:
    """Return the visibility of the tree's cells (see ``LightVisibility.place``)."""
    lanes, number = int(dr.max(place)[0]) + 1, tree.fine.number
    checked(arrays, {"fine": _words(number, lanes)}, closed=True)
    return LightVisibility(tree, _bits(arrays["fine"], number, lanes), place)


def pack_factors(factors: Factors) -> Arrays:
    """Return the arrays of factors."""
    names = ("values", "views", "texel")
    return {name: getattr(factors, name).numpy() for name in names}


def restore_factors(
    arrays: Arrays, texel: np.ndarray, roughness: np.ndarray, channels: int
) -> Factors:
    """Return the factors of (S,) texels at (R,) roughness levels."""
    count = len(texel)
    schema = {
        "values": Field("f4", (count * stride(len(roughness), channels),)),
        "views": Field("u4", (count,)), "texel": Field("u4", (count,)),
    }  # fmt: skip
    checked(arrays, schema, closed=True)
    if not np.array_equal(arrays["texel"], texel):
        raise ValueError("the array texel has other texels")
    return Factors(
        to_drjit(mi.Float, arrays["values"]), to_drjit(mi.UInt32, arrays["views"]),
        to_drjit(mi.UInt32, arrays["texel"]), roughness, channels,
    )  # fmt: skip


def pack_fit(fit: CalibratedFit) -> Arrays:
    """Return the arrays of a calibrated posterior, without its factors."""
    problem, summary = fit.problem, fit.summary
    of_problem = {"scale": problem.scale.numpy(), "min_energy": problem.min_energy.numpy()}
    return of_problem | {
        "noise": fit.noise, "entropy": summary.entropy.numpy(), "total": summary.total.numpy(),
        "mean": np.stack([x.numpy() for x in summary.mean]),
        "sd": np.stack([x.numpy() for x in summary.sd]), "best": summary.best.numpy(),
        "best_colors": np.stack([x.numpy() for x in summary.best_colors]),
    }  # fmt: skip


def restore_fit(arrays: Arrays, problem: CalibratedProblem) -> CalibratedFit:
    """Return the fit of a problem whose noise is unknown."""
    of_texels, (rows, columns, colors) = (problem.factors.count,), problem.shape
    channels = problem.factors.channels
    moments = Field("f4", (1 + len(problem.mixed.axes) + channels, *of_texels))
    schema = {
        **dict.fromkeys(("scale", "min_energy", "entropy", "total"), Field("f4", of_texels)),
        "noise": Field("f8", of_texels), "mean": moments, "sd": moments,
        "best": Field("u4", of_texels, 0, rows * columns - 1),
        "best_colors": Field("u4", (channels, *of_texels), 0, colors - 1),
    }  # fmt: skip
    checked(arrays, schema, closed=True)
    floats = {name: to_drjit(mi.Float, arrays[name]) for name in ("entropy", "total")}
    summary = PosteriorSummary(
        **floats, mean=[to_drjit(mi.Float, row) for row in arrays["mean"]],
        sd=[to_drjit(mi.Float, row) for row in arrays["sd"]],
        best=to_drjit(mi.UInt32, arrays["best"]),
        best_colors=[to_drjit(mi.UInt32, row) for row in arrays["best_colors"]],
    )  # fmt: skip
    problem = replace(
        problem, scale=to_drjit(mi.Float, arrays["scale"]),
        min_energy=to_drjit(mi.Float, arrays["min_energy"]),
    )  # fmt: skip
    return CalibratedFit(problem, arrays["noise"].copy(), summary)


def pack_test(test: FoldTest) -> Arrays:
    """Return the arrays of a test by folds."""
    spread = np.array([test.spread.get(name, 0.0) for name in NAMES])
    tested = test.prediction
    if tested is None:
        return {"spread": spread, "figures": np.zeros(0), "parts": np.zeros((0, 2))}
    cause = list(CAUSES).index(tested.cause)
    parts = [(part.r2, part.coverage) for part in (*tested.sides.values(), *tested.photographs)]
    figures = [tested.r2, tested.r2_of_means, tested.r2_of_diffuse, tested.coverage, cause]
    return {"spread": spread, "figures": np.array(figures, float),
            "parts": np.array(parts).reshape(-1, 2)}  # fmt: skip


def restore_test(arrays: Arrays) -> FoldTest:
    """Return a test by folds."""
    schema = {
        "spread": Field("f8", (len(NAMES),), 0, 1e6),
        "figures": Field("f8", (Axis("number of figures", 0, 5),), -1e300, 1e300),
        "parts": Field("f8", (Axis("number of parts"), 2)),
    }
    checked(arrays, schema, closed=True)
    spread = {n: float(x) for n, x in zip(NAMES, arrays["spread"], strict=True) if x}
    if len(arrays["figures"]) < 5:
        return FoldTest(spread)
    r2, means, diffuse, coverage, cause = arrays["figures"].tolist()
    parts = [PartPrediction(*both) for both in arrays["parts"].tolist()]
    found = HeldOutPrediction(
        r2, means, diffuse, coverage, list(CAUSES)[int(cause) % len(CAUSES)],
        tuple(parts[len(SIDES) :]), dict(zip(SIDES, parts, strict=False)),
    )  # fmt: skip
    return FoldTest(spread, found)


def _words(numbers: int, lanes: int) -> Field:
    return Field("u4", (-(-max(numbers, 1) // WORD) * lanes,))


def _bits(words: np.ndarray, numbers: int, lanes: int) -> Bits:
    return replace(Bits.clear(numbers, lanes), words=to_drjit(mi.UInt32, words))


def pack_share(share: float) -> Arrays:
    """Return the arrays of the share of metals (``metal_share``)."""
    return {"share": np.array([share])}


def restore_share(arrays: Arrays) -> float:
    """Return the share of metals."""
    checked(arrays, {"share": Field("f8", (1,), 0, 1)}, closed=True)
    return float(arrays["share"][0])
