"""What ``run_kernels`` measured, as Markdown tables."""

from __future__ import annotations

from typing import Any

from svu_mi.bench.text import number, seconds, table

Record = dict[str, Any]
MILLION = 1e6


def kernel_tables(record: Record) -> list[str]:
    """Return the tables of a record, of the parts that it has."""
    if not record["cells"]:
        return []
    parts = record["cells"][0]["rows"]
    found = [text for name, show in SHOWN.items() if name in parts for text in show(parts[name])]
    whole = {"scaling", "end_to_end"} <= set(parts)
    return [*found, *_memory(parts)] if whole else found


def _entropy(found: Record) -> list[str]:
    rows = found["rows"]
    cells = [
        [
            row["label"], _spread(row["nanoseconds"]), f"{row['wall_nanoseconds']['median']:.3g}",
            seconds(row["compile"]["seconds"]), row["operations"], f"{row['error']:.1e}",
        ]
        for row in rows
    ]  # fmt: skip
    heads = ("posterior", "ns per texel in kernels", "by the clock", "compilation",
             "operations", "largest error")  # fmt: skip
    return [
        f"## Entropy: {rows[0]['texels']:,} texels",
        "Median (least to greatest). Largest error of the checked texels against double "
        "precision; entropy is in [0, 1].",
        table(heads, cells),
    ]


def _fit(found: Record) -> list[str]:
    rows = found["rows"]
    cells = [
        [
            row["label"], _spread(row["microseconds"]),
            f"{row['wall_microseconds']['median']:.3g}", seconds(row["compile"]["seconds"]),
            row["operations"], f"{row['error']:.1e}",
        ]
        for row in rows
    ]  # fmt: skip
    heads = ("SH fit", "us per texel in kernels", "by the clock", "compilation", "operations",
             "largest error")  # fmt: skip
    return [
        f"## SH fit of six right-hand sides: {rows[0]['texels']:,} texels",
        "Samples are made in the kernel; power spectra are part of it. Error of a degree's power "
        "relative to the largest of its texel and channel, against double precision. All "
        f"kernels together compile in {seconds(found['compile_seconds'])}.",
        table(heads, cells),
    ]


def _gather(found: Record) -> list[str]:
    cells = [
        [
            name, number(way["rays_per_second"] / MILLION, 1),
            seconds(way["kernel"]["median"]), seconds(way["wall"]["median"]),
            f"{way['free']:,}",
        ]
        for name, way in found["ways"].items()
    ]  # fmt: skip
    return [
        f"## Gather: {found['texels']:,} texels, {found['views']} views, "
        f"{found['triangles']:,} triangles",
        f"The {found['rays']:,} visibility rays that are left after all cheaper tests, traced by "
        f"the survey and by themselves; it reaches {found['ratio']:.0%} of the faster of both.",
        table(("way", "million rays per second", "in kernels", "by the clock", "free rays"), cells),
    ]


def _end_to_end(found: Record) -> list[str]:
    methods = found["methods"]
    stages = _merged([list(m["warm"]["stages"]) for m in methods.values()])
    cells = [
        [stage] + [
            seconds(value) if value is not None else ""
            for m in methods.values()
            for value in (
                m["warm"]["stages"].get(stage, {}).get("median"), m["cold"]["stages"].get(stage)
            )
        ]
        for stage in stages
    ]  # fmt: skip
    for name, key in (("all", "seconds"), ("with start and imports", "process_seconds")):
        cells.append([name])
        for m in methods.values():
            warm = _spread(m["warm"][key]) + " s" if key in m["warm"] else ""
            cells[-1] += [warm, seconds(m["cold"][key])]
    counts = [m[how]["kernels"] for m in methods.values() for how in ("warm", "cold")]
    cells.append(["kernels compiled", *map(str, counts)])
    heads = [f"{name}, {how}" for name in methods for how in ("warm", "cold")]
    return [
        f"## From files to entropy.exr: {found['texels']:,} texels of {found['resolution']} x "
        f"{found['resolution']}, {found['views']} photographs, "
        f"{found['pixels'] / MILLION:.1f} million pixels",
        table(("stage", *heads), cells),
    ]


def _skipping(found: Record) -> list[str]:
    cells = []
    for row in found["rows"]:
        ways = row["by_way"]
        least = ways["skipping"]
        cells.append([
            row["photographs"], row["method"], *(seconds(value) for value in ways.values()),
            *(f"{ways[name] / least:.2f}" for name in list(ways)[1:]), f"{row['error']:.1e}",
        ])  # fmt: skip
    ways = list(found["rows"][0]["by_way"])
    heads = ("photographs", "estimator", *ways, *(f"{name}, times" for name in ways[1:]),
             "change of entropy")  # fmt: skip
    return [
        "## Skipping",
        f"Charts cover {found['coverage']:.0%} of the map, the light is grey, metallic is 0 and "
        "known; three colour channels. Without skipping a prior says that metallic is 0, and all "
        "texels of the charts are worked on in all views, seen or not; with every texel, those "
        "outside the charts cost as much as those inside.",
        table(heads, cells),
    ]


def _scaling(found: Record) -> list[str]:
    cells = []
    for curve in found["curves"]:
        fit, points = curve["line"], curve["points"]
        times = ", ".join(f"{p['n']:,}: {p['seconds']['low']:.3g}" for p in points)
        cells.append([curve["method"], curve["what"], times, seconds(fit["a"]), _short(fit["b"]),
                      number(fit["r2"], 3), number(fit["slope"])])  # fmt: skip
    heads = ("estimator", "n", "seconds of n", "a", "b", "R^2", "exponent, upper half")
    return [
        "## Scaling of an estimate",
        f"Least seconds of several runs by the clock, and a + b n; texels with {found['views']} "
        f"views, views with {found['resolution']} x {found['resolution']} texels.",
        table(heads, cells),
    ]


def _memory(record: Record) -> list[str]:
    scaling, whole = record["scaling"]["bytes_per_texel"], record["end_to_end"]["methods"]
    cells = [
        [
            method, number(found["allocator"], 0), number(found["formula"], 0),
            _mib(whole[method]["cold"]["peak_mib"]), _mib(whole[method]["cold"]["formula_mib"]),
        ]
        for method, found in scaling.items()
    ]  # fmt: skip
    heads = ("estimator", "bytes per texel, allocator", "formula", "resident peak", "formula")
    return [
        "## Memory",
        "How the peak of Dr.Jit's allocator grows with texels; the formula of the README counts "
        "all that is resident. The resident peak is that of the cold run above.",
        table(heads, cells),
    ]


def _merged(orders: list[list[str]]) -> list[str]:
    """Return the names of several lists, each new one after its predecessor."""
    merged: list[str] = []
    for order in orders:
        place = 0
        for name in order:
            if name not in merged:
                merged.insert(place, name)
            place = merged.index(name) + 1
    return merged


def _short(value: float) -> str:
    """Return a time in the largest unit in which it is at least 1."""
    for unit, name in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us")):
        if abs(value) >= unit:
            return f"{value / unit:.3g} {name}"
    return f"{value * 1e9:.3g} ns"


def _spread(found: Record) -> str:
    return f"{found['median']:.3g} ({found['low']:.3g} to {found['high']:.3g})"


def _mib(value: float | None) -> str:
    return "" if value is None else f"{value:,.0f} MiB"


SHOWN = {"entropy": _entropy, "fit": _fit, "gather": _gather, "end_to_end": _end_to_end,
         "skipping": _skipping, "scaling": _scaling}  # fmt: skip
