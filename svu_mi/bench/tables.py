"""bench.md: what a benchmark found, as Markdown tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from svu_mi.bench.failures import left_out
from svu_mi.bench.guidance import guidance_tables
from svu_mi.bench.recovery import recovery_tables
from svu_mi.bench.text import number, seconds, table
from svu_mi.files import write_text

Record = dict[str, Any]
SCALED = {
    "degree": "degree l*",
    "grid": "nodes per axis",
    "views": "views",
    "reference_spp": "samples of the reference",
}
BENCHMARKS: tuple[tuple[str, str, Callable[[Any], str]], ...] = (
    ("recovery", "Recovery of textures", recovery_tables),
    ("guidance", "Capture guidance", guidance_tables),
)


def write_tables(path: Path, record: Record) -> None:
    """Write the tables of a benchmark.

    Args:
        path: the Markdown file.
        record: what ``run_bench`` returns.

    Raises:
        OutputError: the file cannot be written.
    """
    parts = ["# Benchmark", _heading(record)]
    if record["cells"]:
        parts += [*_agreement(record), *_calibration(record), *_parameters(record),
                  *_cells(record)]  # fmt: skip
    parts += left_out("Left out", record)
    if record["checks"]:
        parts += _checks(record["checks"])
    if record["speed"]:
        parts += speed_tables(record["speed"])
    for part, title, tables in BENCHMARKS:
        if record[part]:
            parts += [f"# {title}", tables(record[part])]
    write_text(path, "\n\n".join(parts))


def _heading(record: Record) -> str:
    size = record["settings"]
    return (
        f"{told_how(record)}\n\n{len(record['cells'])} cells (object / light); "
        f"{size.views} photographs of {size.film} x {size.film} with {size.spp} samples per "
        f"pixel, {size.texels} x {size.texels} texels, reference on {size.reference_texels} "
        f"texels with {size.reference_spp} samples."
    )


def told_how(record: Record) -> str:
    """Return the sentence about what ``run.how_it_was_run`` returned."""
    place = record["environment"]
    versions = place["versions"]
    return (
        f"`{record['command']}`, {record['date']}; svu_mi {versions['svu_mi']}, Mitsuba "
        f"{versions['mitsuba']}, Dr.Jit {versions['drjit']}, {place['variant']}, "
        f"{place['threads']} threads, {place['platform']}."
    )


def _agreement(record: Record) -> list[str]:
    rows = [
        [
            row["label"], _interval(row["pearson"]), _mean(row["spearman"]),
            number(row.get("mean_entropy")), number(row.get("ause_relative")),
            seconds(row["seconds"]) if row["kind"] in ("main", "switch") else "",
        ]
        for row in _ordered(record["summary"])
    ]  # fmt: skip
    return [
        "## Agreement with the path-traced posterior",
        "Correlation of the entropy with that of the reference, which assumes a noise of 8 % of "
        "the mean radiance, as `fixed` does: mean over cells, and a 95 % bootstrap interval over "
        "objects. That of the reference is between two halves of its "
        "samples. AUSE: area between the sparsification curves by entropy and by true error of "
        "the most probable cell, over that of a random order: 0 perfect, 1 chance. Seconds are "
        "warm, mean over cells.",
        table(("map", "Pearson", "Spearman", "mean entropy", "AUSE", "time"), rows),
    ]


def _calibration(record: Record) -> list[str]:
    judged = [row for row in record["summary"] if row["kind"] in ("main", "reference")]
    levels = list(judged[0]["credible"])
    heads = [f"{float(level):.0%} {name}" for level in levels for name in
             ("whole cells", "fractional", "part of the grid")]  # fmt: skip
    rows = [
        [row["label"]]
        + [
            f"{row['credible'][level][name]:.0%}"
            for level in levels
            for name in ("plain", "fractional", "size")
        ]
        for row in judged
    ]
    return [
        "## Credible sets against the true parameters",
        "How often the highest-density set holds the truth's cell. A set of whole cells holds at "
        "least its level, so even a calibrated posterior exceeds it; with the last cells taken "
        "in with the fitting probability it does not.",
        table(("posterior", *heads), rows),
    ]


def _parameters(record: Record) -> list[str]:
    rows = [
        [row["label"], name]
        + [f"{figures['bias']:+.3f}"]
        + [
            number(figures[key], 3)
            for key in ("mae", "rmse", "entropy_correlation", "ause_relative")
        ]
        for row in record["summary"]
        if row["kind"] in ("main", "reference")
        for name, figures in row["parameters"].items()
    ]
    heads = ("posterior", "parameter", "bias", "MAE", "RMSE", "rho(error, entropy)", "AUSE")
    return ["## Error of the most probable cell", table(heads, rows)]


def _cells(record: Record) -> list[str]:
    main = [row["label"] for row in record["summary"] if row["kind"] == "main"]
    sanity = [row["label"] for row in record["summary"] if row["kind"] == "sanity"]
    rows = [
        [f"{cell['object']} / {cell['light']}"]
        + [number(cell["variants"][label]["pearson"]) for label in main]
        + [number(cell["sanity"][label]["pearson"]) for label in sanity]
        + [number(cell["reference"][name], 3) for name in ("split_half", "half_overlap")]
        for cell in record["cells"]
    ]
    heads = ("object / light", *main, *sanity, "reference's halves", "their shared mass")
    return [
        "## Pearson correlation by cell",
        "The halves are those of the reference's samples: the correlation of their entropies, "
        "and the part of their posteriors that they have in common.",
        table(heads, rows),
    ]


def _checks(checks: Sequence[Record]) -> list[str]:
    cases = {
        "direct": "direct light",
        "photographs": "all light in the photographs",
        "both": "all light in both",
        "heteroscedastic": "noise grows with radiance",
        "estimated": "noise is estimated",
    }
    rows = [
        [found["cell"], label, *(number(row[case]) for case in cases), number(found["references"])]
        for found in checks
        for label, row in found["estimators"].items()
    ]
    return [
        "## Light between parts of the object, and other noise",
        f"Pearson correlation with references in which every psi is rendered, on up to "
        f"{checks[0]['texels']} texels: of direct light, as above; with photographs of up to "
        "5 bounces against the reference of direct light; with the same photographs against a "
        "reference of up to 3 bounces, in which all of the object has the psi in question; and "
        "of direct light, with noise that grows with radiance, and with noise that is estimated, "
        "as `default` and `fast` do. Last, the references of direct and of all light with each "
        "other.",
        table(("object / light", "map", *cases.values(), "both references"), rows),
    ]


def _ordered(rows: Sequence[Record]) -> list[Record]:
    order = {"main": 0, "switch": 1, "sanity": 2, "reference": 3}
    return sorted(rows, key=lambda row: order[row["kind"]])


def _interval(found: Record | None) -> str:
    if found is None or found["low"] is None:
        return _mean(found)
    return f"{found['mean']:.2f} ({found['low']:.2f} to {found['high']:.2f})"


def _mean(found: Record | None) -> str:
    return "" if found is None else number(found["mean"])


# --- run times ------------------------------------------------------------------------------


def speed_tables(speed: Record) -> list[str]:
    """Return the parts of bench.md that tell run times.

    Args:
        speed: what ``run_speed`` returns.
    """
    return [*_speed(speed), *_scaling(speed), *_brute(speed["brute"])]


def _speed(speed: Record) -> list[str]:
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


def _scaling(speed: Record) -> list[str]:
    rows = [
        [SCALED[what], label, row["value"], seconds(row["seconds"]), number(row["pearson"], 3)]
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


def _brute(brute: Record) -> list[str]:
    return [
        "## Path-traced posterior of all texels (extrapolated)",
        f"{brute['pairs']:,} visible (texel, view) pairs x {brute['psi']} psi x {brute['spp']} "
        f"samples / {brute['rays_per_second']:.3g} rays per second = "
        f"**{seconds(brute['seconds'])}**, or {seconds(brute['linear_seconds'])} with the 32 psi "
        f"that are enough for direct light. The rate is measured, warm: "
        f"{brute['sample_rays']:,} rays in {seconds(brute['sample_seconds'])}.",
    ]
