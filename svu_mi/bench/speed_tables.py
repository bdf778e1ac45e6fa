"""Run times as Markdown tables."""

from __future__ import annotations

from typing import Any

from svu_mi.bench.text import number, seconds, table

NAMES = {
    "degree": "degree l*",
    "grid": "nodes per axis",
    "views": "views",
    "reference_spp": "samples of the reference",
}


def speed_tables(speed: dict[str, Any]) -> list[str]:
    """Return the parts of bench.md that tell run times.

    Args:
        speed: what ``run_speed`` returns.
    """
    return [*_estimators(speed), *_scaling(speed), *_brute(speed["brute"])]


def _estimators(speed: dict[str, Any]) -> list[str]:
    found = speed["estimators"]
    variants = found["variants"]
    stages = list(dict.fromkeys(stage for v in variants.values() for stage in v["warm"]))
    rows = [
        [stage]
        + [
            seconds(v[how][stage] if how == "warm" else v["cold"]["timings"][stage])
            if stage in v["warm"] else ""
            for v in variants.values()
            for how in ("warm", "cold")
        ]
        for stage in stages
    ]  # fmt: skip
    rows.append(
        ["all"]
        + [
            seconds(value)
            for v in variants.values()
            for value in (v["warm_seconds"], v["cold"]["seconds"])
        ]
    )
    rows.append(
        ["kernels compiled"]
        + [count for v in variants.values() for count in (0, v["cold"]["kernels"])]
    )
    heads = [f"{label}, {how}" for label in variants for how in ("warm", "cold")]
    repeats = next(iter(variants.values()))["repeats"]
    return [
        f"## Run time: {speed['cell']}, {found['texels']} texels of {found['resolution']} x "
        f"{found['resolution']}, {found['views']} photographs of {found['film']} x "
        f"{found['film']}",
        f"Warm: median of {repeats}. Cold: one new process with an empty kernel cache.",
        table(("stage", *heads), rows),
    ]


def _scaling(speed: dict[str, Any]) -> list[str]:
    rows = [
        [NAMES[what], label, row["value"], seconds(row["seconds"]), number(row["pearson"], 3)]
        for what, curves in speed["scaling"].items()
        for label, curve in curves.items()
        for row in curve
    ]
    return [
        f"## Run time against agreement: {speed['cell']}",
        "Pearson correlation with the reference posterior of the same photographs; for the "
        "reference itself, with its largest number of samples.",
        table(("what", "estimator", "value", "time", "Pearson"), rows),
    ]


def _brute(brute: dict[str, Any]) -> list[str]:
    return [
        "## Path-traced posterior of all texels (extrapolated)",
        f"{brute['pairs']:,} visible (texel, view) pairs x {brute['psi']} psi x {brute['spp']} "
        f"samples / {brute['rays_per_second']:.3g} rays per second = "
        f"**{seconds(brute['seconds'])}**, or {seconds(brute['linear_seconds'])} with the 32 psi "
        f"that are enough for direct light. The rate is measured, warm: "
        f"{brute['sample_rays']:,} rays in {seconds(brute['sample_seconds'])}.",
    ]
