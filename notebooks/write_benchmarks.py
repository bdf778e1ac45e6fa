"""Write BENCHMARKS.md and benchmarks/*.md from records: python notebooks/write_benchmarks.py [OUT].

OUT is a folder with results of ``svu bench``; its STUDY.json files are copied to benchmarks/ first.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.bench import BENCHMARKS
from svu_mi.bench.accuracy.accuracy_tables import OTHER_NOISE
from svu_mi.bench.guidance.guidance_tables import compare, views_needed, views_ratio
from svu_mi.bench.markdown import BAR_COLUMNS, seconds, table
from svu_mi.bench.orb.orb_tables import PUBLISHED
from svu_mi.bench.orb.orb_targets import FIGURES
from svu_mi.bench.paper.figure9 import ADDED, FARTHEST, OURS, PAPER, increases
from svu_mi.bench.recovery.methods import (
    PATH,
    PATH_PAPER,
    PATH_PAPER_SHARING,
    ROWS,
    SH,
    SH_PAPER,
    SH_PAPER_PATH,
    SH_PAPER_SHARING,
    SH_PATH,
    SH_SHARING,
    SPECTRUM,
)
from svu_mi.bench.study import figures, provenance, read_record, study_of

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "notebooks" / "benchmarks"
# Estimators and photographs whose results are on the pages of the studies only, and simple maps.
LESS = ("spectrum paper, relative noise", "black table", "direct light, from above",
        "all bounces, ignored")
COMPARED = ("angular default", "angular fixed", "angular fast")  # in times
SIMPLE = ("brightness", "number of views")
Record = dict[str, Any]
Row = Sequence[str]
DPI = 80  # resolution of plots
DIGITS, FEW = 6, 3  # significant digits of copied numbers, and of numbers in long lists
LONG, THINNED = 20, 4  # entries of a long list; step between the kept points of scatter plots
DERIVED = ("bars", "summary")  # entries that ``read_record`` computes again


def mean(values: Iterable[Any]) -> float:
    """Return the mean of the known values; NaN without any."""
    known = [float(value) for value in values if value is not None]
    return float(np.mean(known)) if known else float("nan")


def both(values: Iterable[Any]) -> str:
    """Return the mean of values, and the lowest of them in brackets."""
    known = [value for value in values if value is not None]
    return f"{mean(known):.3f} ({min(known):.2f})" if known else "-"


def rows_of(record: Record, part: str) -> list[Record]:
    """Return the results of a row, one per case that has it."""
    return [case["rows"][part] for case in record["cells"] if part in case["rows"]]


def bars(record: Record, chosen: Mapping[str, Sequence[str]]) -> list[Row]:
    """Return a row per title with its bars joined; a bar is found by the start of its name."""
    rows = []
    for title, starts in chosen.items():
        found = [bar for start in starts for bar in record["bars"] if bar["what"].startswith(start)]
        shown = [[column.text(bar) for column in BAR_COLUMNS] for bar in found]
        values, limits = (list(dict.fromkeys(texts)) if len(set(texts)) == 1 else texts
                          for texts in ([line[1] for line in shown], [line[2] for line in shown]))  # fmt: skip
        missed = "" if all(bar["holds"] for bar in found) else ", **missed**"
        rows += [[title, " / ".join(values), " / ".join(limits) + missed]] if found else []
    return rows


# --- rows of quantity, value and comparison, by study -----------------------------------------


def agreement(record: Record) -> list[Row]:
    cases, halves = record["cells"], [case["reference"]["split_half"] for case in record["cells"]]
    compared = {"spectrum paper": "paper: .88", "angular SH model": "paper: .94, sum over views",
                **dict.fromkeys(OTHER_NOISE, "other noise")}  # fmt: skip
    rows = []
    for row in record["summary"]:
        if row["kind"] == "estimator" and row["label"] not in LESS:
            values = both(case["rows"][row["label"]]["pearson"] for case in cases)
            rows.append([f"`{row['label']}`", f"{values}; {seconds(row['seconds'])}",
                         compared.get(row["label"], "")])  # fmt: skip
    simple = [both(case["sanity"][name]["pearson"] for case in cases) for name in SIMPLE]
    return [*rows, [f"{' / '.join(SIMPLE)} alone", " / ".join(simple), ""],
            ["halves of the reference's samples", both(halves), "upper limit"]]  # fmt: skip


UNMODELLED = {"table": "unknown table", "bounces": "unmodelled bounces", "poses": "wrong poses",
              "found light": "estimated light"}  # fmt: skip


def sets(record: Record) -> list[Row]:
    found, traced = rows_of(record, "default"), rows_of(record, "traced")
    names = ("r", "m", "c", "rm")

    def joined(start: str, chosen: Sequence[str] = names[:3]) -> str:
        return " / ".join(f"{mean(row[f'{start} {name}'] for row in found):.2f}" for name in chosen)

    return [
        ["90 % sets: roughness / metallic / base colour / first two jointly", joined("90", names),
         ".90"],
        ["90 % intervals: roughness / metallic / base colour", joined("interval"), ".90"],
        ["predicted and true error of a texel, Spearman", both(row["spearman"] for row in found),
         "1"],
        *bars(record, {
            "intervals of roughness narrower than .1: contain the truth / number, relative to before":
                ["narrow intervals of roughness with", "narrow intervals of roughness, rel"],
            **{f"90 % intervals, {name}": [f"{start}: 90 % intervals"]
               for start, name in UNMODELLED.items()},
        }),
        ["PSNR of posterior means, the same (dB)", joined("psnr"), ""],
        ["entropy against path tracing with the same likelihood, Pearson: same prior / as shown",
         " / ".join(both(row.get(key) for row in traced) for key in ("rho", "rho now")),
         f"{mean(row['halves'] for row in traced):.2f}: halves of the reference's samples"],
    ]  # fmt: skip


def textures(record: Record) -> list[Row]:
    ways = (SH, SH_SHARING, SH_PATH, PATH, SH_PAPER)
    found = {way.label: rows for way in ways if (rows := rows_of(record, way.label))}
    limit = mean(case["truth_relit"]["psnr_ldr"] for case in record["cells"])
    return [
        *([f"`{label}`: PSNR of textures / relit pictures; time",
           f"{mean(row['psnr']['average'] for row in rows):.1f} / "
           f"{mean(row['relit']['psnr_ldr'] for row in rows):.1f} dB; "
           f"{seconds(mean(row['seconds'] for row in rows))}",
           "" if label != SH.label else f"{limit:.1f} dB: relit true textures"]
          for label, rows in found.items()),
    ]  # fmt: skip


def intervals(record: Record) -> list[Row]:
    names = ("base_color", "roughness", "metallic")
    whole, worst, shared = (
        [f"{part}: {name}, intervals that contain the truth{end}" for name in names]
        for part, end in (("textures", ", at least"), ("textures", ", worst"), ("shared", "")))
    return bars(record, {
        "90 % intervals of textures: base colour / roughness / metallic; worst cases": whole + worst,
        "the same, with `--sharing` and photographs mostly from one side": shared,
        "90 % intervals of a third of the surface that is filled": ["filled: intervals"],
        "filled texels, PSNR above spreading from the border: mean / worst case": ["filled: PSNR"],
        "pixels of relit pictures within 1.64 standard deviations": ["pictures: pixels"],
        "standard deviation and error, Spearman: textures / pictures":
            ["textures: Spearman", "pictures: Spearman"],
    })  # fmt: skip


def verdicts(record: Record) -> list[Row]:
    return bars(record, {
        "sound captures called reliable / with a mistake: called unreliable / cause named":
            ["sound captures", "captures with a mistake that", "captures with a mistake whose"],
    })  # fmt: skip


def reflections(record: Record) -> list[Row]:
    """Return PSNR and intervals of the parameters, and errors of radiance, for each light."""
    names = dict.fromkeys(name for case in record["cells"] for name in case["rows"])
    found = {name: rows_of(record, name) for name in names}

    def means(name: str, what: str, form: str = ".1f") -> str:
        values = [[row.get(f"{what} {key}") for row in found[name]] for key in "rmc"]
        return " / ".join(f"{mean(x):{form}}" for x in values if None not in x)

    def won_back(without: str, within: str) -> str:
        """Return the share of the loss by ignoring a grey table that a known one does not have."""
        best, known, ignored = (
            [mean(row[f"{kind} {key}"] for row in found[name]) for key in "rmc"]
            for name, kind in (("direct light, from above", within), ("grey table", within),
                               ("grey table, ignored", without))
        )  # fmt: skip
        shares = [(k - i) / (b - i) for b, k, i in zip(best, known, ignored, strict=True)]
        return " / ".join(f"{100 * share:.0f}" for share in shares) + " %"

    return [
        [name, means(name, "psnr"), means(name, "interval", ".2f"),
         " / ".join(f"{100 * mean(row[f'radiance {key}'] for row in rows):.1f} %"
                    for key in ("median", "rms") if f"radiance {key}" in rows[0]),
         means(name, "some"), means(name, "traced")]
        for name, rows in found.items() if name not in LESS
    ] + [["loss by ignoring the grey table, won back", won_back("psnr", "psnr"), "", "",
          won_back("some", "some"), won_back("some", "traced")]]  # fmt: skip


def poses(record: Record) -> list[Row]:
    """Return the shift of cameras, and the PSNR of textures, for the larger errors."""
    keys, result = ("roughness", "metallic", "base_color"), []
    for name in ("0.2 degrees", "0.5 degrees", "0.2 degrees, no masks"):
        rows, exact = rows_of(record, name), rows_of(record, "exact")
        shift = " / ".join(f"{mean(row['pixels' + when] for row in rows):.2f}"
                           for when in (" before", ""))  # fmt: skip
        psnr = [" / ".join(f"{mean(row[key + when] for row in of):.1f}" for key in keys)
                for of, when in ((exact, " before"), (rows, " before"), (rows, ""))]  # fmt: skip
        result.append([name, shift, *psnr])
    return result


def lights(record: Record) -> list[Row]:
    return bars(record, {
        "correlation of the environment maps: mean / worst glossy case":
            ["correlation of the environment map"],
        "share of cases with the brightest direction within 15 degrees": ["brightest"],
        "correlation of the entropies under both lights: mean / worst case":
            ["correlation of the entropy"],
        "share of cases with the scale inside its 90 % interval": ["scale"],
        "90 % intervals of textures that contain the truth": ["90 % intervals"],
        "PSNR lost: roughness / metallic / base colour":
            [f"{name}: PSNR" for name in ("roughness", "metallic", "base_color")],
    })  # fmt: skip


def views(record: Record) -> list[Row]:
    runs, sizes = record["cells"], record["sizes"].guidance
    kinds = list(dict.fromkeys(run["kind"] for run in runs))
    own = [[run for run in runs if run["kind"] == kind] for kind in kinds]
    pairs = [pair for pair in compare(runs, sizes) if pair["strategy"] == "entropy"]
    return [
        [f"views for +{sizes.step:g} dB, farthest over entropy: {' / '.join(kinds)} starts",
         " / ".join(f"{views_ratio(some, sizes, 'entropy', 'farthest'):.2f}" for some in own),
         "paper: 1.6"],
        ["expected and measured change of the entropy, Pearson, the same",
         " / ".join(both(run["agreement"]["correlation"] for run in some) for some in own),
         ">= .8"],
        [f"mean gain of PSNR, entropy over {' / '.join(pair['other'] for pair in pairs)}",
         " / ".join(f"{pair['difference']:+.2f}" for pair in pairs) + " dB",
         f"p = {' / '.join(format(pair['p'], '.2g') for pair in pairs)}"],
    ]  # fmt: skip


def printed(record: Record) -> list[Row]:
    parts = {name: {"cells": [case for case in record["cells"] if case["part"] == name]}
             for name in ("table3", "table2", "figure9")}  # fmt: skip
    labels = (SH_PAPER.label.replace("SH", "SH model"), SPECTRUM.label, "fixed")
    rows: list[Row] = [[
        f"Table 3, entropy against path tracing: `{'` / `'.join(labels)}`",
        " / ".join(both(row["rho"] for row in rows_of(parts["table3"], one)) for one in labels),
        ".94 / .88",
    ]]  # fmt: skip
    found = {way.label: rows_of(parts["table2"], way.label) for way in ROWS}
    psnr = {label: mean(row["psnr"]["average"] for row in few) for label, few in found.items()}
    sh, path = SH_PAPER.label, PATH_PAPER.label
    pairs = ((sh, path), (SH_PAPER_SHARING.label, sh), (PATH_PAPER_SHARING.label, path))
    rows += [
        ["Table 2, PSNR: SH model over path tracing / sharing, SH model / sharing, path tracing",
         " / ".join(f"{psnr[a] - psnr[b]:+.2f}" for a, b in pairs) + " dB",
         "-1.36 / +2.38 / +0.81 dB"],
        [f"Table 2, PSNR: `{SH.label}` over `{sh}`", f"{psnr[SH.label] - psnr[sh]:+.2f} dB", ""],
        [f"Table 2, error with entropy, Pearson: `{sh}` / `{SH.label}`", " / ".join(
            f"{mean(row['correlation'] for row in found[label]):.2f}" for label in (sh, SH.label)),
         ".22"],
    ]  # fmt: skip
    if cases := parts["figure9"]["cells"]:
        needed = [views_needed(ADDED, increases(cases, s, "psnr", "default").mean(axis=0).tolist(),
                               1.0) for s in (PAPER, OURS, FARTHEST)]  # fmt: skip
        rows.append(["Figure 9, views for +1 dB, farthest over Eq. 13 / over ours",
                     " / ".join(f"{needed[2] / one:.2f}" for one in needed[:2]), "1.6"])  # fmt: skip
    return rows


def orb(record: Record) -> list[Row]:
    paper = dict(zip(("", PATH_PAPER.label, SH_PAPER.label, SPECTRUM.label, SH_PAPER_PATH.label),
                     PUBLISHED, strict=True))  # fmt: skip
    rows = []
    for label in record["cells"][0]["rows"]:
        found = rows_of(record, label)
        values = [mean(row["light"]["mean"][name] for row in found) for name in FIGURES[:3]]
        _, *known, _, time = paper.get(label, ("", 0.0, 0.0))
        rows.append([
            f"Table 1, relighting, PSNR-H / PSNR-L / SSIM; time: `{label}`",
            f"{' / '.join(f'{value:.3g}' for value in values)}; "
            + seconds(mean(row["seconds"] for row in found)),
            f"{' / '.join(f'{value:.3g}' for value in known)}; {time:g} s" if known else "",
        ])  # fmt: skip
    return rows


def times(record: Record) -> list[Row]:
    parts = record["cells"][0]["rows"]
    brute, ways = parts["brute"], parts["whole_way"]
    peak, formula = (" / ".join(f"{way['cold'][key]:.0f}" for way in ways.values()) + " MiB"
                     for key in ("peak_mib", "formula_mib"))  # fmt: skip
    return [
        *([f"`{label}`, compiled / with compilation", f"{seconds(part['warm_seconds'])} / "
           f"{seconds(part['cold']['seconds'])}", ""]
          for label, part in parts["estimators"].items() if label in COMPARED),
        *bars(record, {
            "files to entropy.exr, `default`: compiled / new process with compilation":
                [f"files to entropy.exr, angular: {end}" for end in ("compiled", "new process")],
        }),
        ["path-traced posterior of all texels, extrapolated", seconds(brute["seconds"]),
         f"{seconds(brute['linear_seconds'])} if light is direct"],
        [f"peak memory from files to entropy.exr: {' / '.join(ways)}", peak, f"formula: {formula}"],
    ]  # fmt: skip


def growth(record: Record) -> list[Row]:
    curves, rows = record["cells"][0]["rows"].values(), []
    for method in dict.fromkeys(curve["method"] for curve in curves):
        texel, view = (next(one for one in curves if (one["method"], one["what"]) == (method, what))
                       for what in ("texels", "views"))  # fmt: skip
        n, mib = ([point[key] for point in texel["points"]] for key in ("n", "allocated_mib"))
        lines = texel["line"], view["line"]
        rows.append([
            f"{method}: exponents of texels / views; time of each; memory of a texel",
            " / ".join(f"{line['slope']:.2f}" for line in lines)
            + f"; {1e6 * lines[0]['b']:.3g} us / {1e3 * lines[1]['b']:.3g} ms; "
            f"{2**20 * np.polyfit(n, mib, 1)[0]:.0f} bytes; R^2 {min(x['r2'] for x in lines):.3f}",
            "<= 1.1; R^2 >= .95",
        ])  # fmt: skip
    return rows


def predicted(record: Record) -> list[Row]:
    (case,) = record["cells"]
    values = " / ".join(f"{row['r2']:.3f}" for row in case["rows"].values())
    return [[f"R^2 of held-out photographs: {' / '.join(case['rows'])}", values, ""], *bars(
        record, {"R^2 above texel means": ["R^2"],
                   "90 % intervals that contain held-out pixels": ["90 % intervals"]})]  # fmt: skip


def bounces(record: Record) -> list[Row]:
    shown = (
        ("angular fixed", "direct light", "direct", None, ""),
        ("angular fixed", "all light, `--bounces`", "bounces", "both", "without it"),
        ("angular default", "all light, `--bounces`", "estimated bounces", "estimated",
         "direct light"),
    )  # fmt: skip
    rows = []
    for label, words, kind, other, of_other in shown:
        found = [row for row in rows_of(record, label) if kind in row]
        halves = mean(case["halves"][kind]["spearman"] for case in record["cells"])
        values, beside = ([row[name]["spearman"] for row in found if name in row]
                          for name in (kind, other))  # fmt: skip
        compared = f"{both(beside)}: {of_other}" if beside else f"{halves:.3f}: halves of the paths"
        rows += [[f"`{label}`: {words}", both(values), compared]] if found else []
    return rows


# --- pages ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Section:
    """A section of BENCHMARKS.md: a text, and a table with rows of one or two studies."""

    title: str
    text: str
    rows: dict[str, Callable[[Record], list[Row]]]
    heads: Row = ("quantity", "measured", "compare with")
    picture: str = ""


SECTIONS = (
    Section(
        "Entropy against path tracing",
        "The entropy of a texel lies between 0 (parameters certain) and 1 (unknown). The reference "
        "renders each texel with every material of the grid and assumes noise of 8 % of the mean "
        "radiance, as the preset `fixed` does. `default` and `fast` estimate the noise (other noise), which "
        "alone changes the entropy; the next table has `default` and a reference of the same "
        "likelihood. Values are Pearson correlations over "
        "texels, mean over cases (worst case), and times for all texels of a 256 x 256 texture.",
        {"accuracy": agreement}, picture="time_error",
    ),
    Section(
        "Calibration",
        "A 90 % set of a calibrated posterior contains the true parameters of 90 % of all texels; "
        "a lower share means error bars that are too narrow. All rows are of the preset `default`.",
        {"calibration": sets},
    ),
    Section(
        "Textures and their intervals",
        "Textures recovered from 40 photographs are compared with the true ones over all visible "
        "texels, and in pictures under another light. `SH (ours)` is the default of `svu recover`; "
        "`path` differentiates a path tracer. The rows with 90 % intervals are shares of texels or "
        "pixels whose interval contains the truth.",
        {"recovery": textures, "sureness": intervals},
    ),
    Section(
        "Captures with mistakes",
        "Nine mistakes, three captures of each: estimates should call them unreliable, and name the "
        "cause. The limits were chosen on the same objects under `window` and `studio`.",
        {"verdict": verdicts},
    ),
    Section(
        "Tables, bounces and lamps",
        "Posterior means and 90 % intervals in photographs of direct light, of all bounces, on tables, "
        "under four area lights, and with a flash alone (60 photographs of 256 x 256): PSNR, and share "
        "of intervals with the truth, of roughness, metallic and base colour. Radiance of the model "
        "with the true textures is compared with path tracing. Path-traced posteriors of 200 texels "
        "show what the photographs determine.",
        {"reflected": reflections},
        heads=("photographs", "PSNR", "90 % intervals", "error of radiance: median / rms",
               "PSNR, 200 texels", "path traced"),
    ),
    Section(
        "Refined poses",
        "Cameras are rotated at random by three angles (rms), and translated by the same part of "
        "their distance. Shift of the object in the photographs in pixels, and PSNR of posterior "
        "means of roughness, metallic and base colour, before and after `svu refine`.",
        {"poses": poses},
        heads=("cameras", "pixels: before / after", "exact cameras", "before", "after"),
    ),
    Section(
        "Light estimated from the photographs",
        "The environment map is estimated from the object's pixels alone and compared with the true "
        "one, as are the textures and entropies that follow from both.",
        {"light": lights},
    ),
    Section(
        "Guidance",
        "Views are added to four photographs, one at a time, by several strategies, and textures are "
        "recovered from them. `entropy` is the default of `svu guide`, `farthest` is farthest-point "
        "sampling. A ratio above 1 means that `entropy` needs fewer photographs.",
        {"guidance": views},
    ),
    Section(
        "The paper's tables and figures",
        "Presets `paper` implement Wiersma et al. 2025 as printed. The last column has the paper's "
        "own numbers, measured on other scenes. Table 1 is measured on our scenes in the layout of "
        "Stanford-ORB, not on that data set; its published times are of an RTX 4090.",
        {"paper": printed, "orb": orb}, ("quantity", "measured", "paper"),
    ),
    Section(
        "Run time, scaling and memory",
        "Times are for a 512 x 512 texture and 60 photographs of 512 x 512 pixels, in memory or from "
        "files. The first time is with compiled kernels, the second includes their compilation. "
        "A line is fitted to the run times of an estimate by number of texels and of views; an "
        "exponent of at most 1 means that time grows no faster than linearly. Commands stop if a "
        "formula predicts more memory than is available; it is compared with the measured peak.",
        {"speed": times, "scaling": growth},
    ),
    Section(
        "Real photographs",
        "Every fifth photograph of a real capture is predicted from the others. `texel means` "
        "predicts the mean of each texel's samples, `diffuse only` a diffuse surface.",
        {"real": predicted},
    ),
    Section(
        "Light between parts of the object",
        "Entropy against path tracing (Spearman) where light bounces within the object. The "
        "reference gives each texel all materials, while the rest of the object keeps its own.",
        {"paths": bounces},
    ),
)  # fmt: skip


def short(records: dict[str, Record]) -> list[Row]:
    """Return the most important results of the default, for the first table."""
    rows: list[Row] = []
    if "accuracy" in records:
        fixed = rows_of(records["accuracy"], "angular fixed")
        halves = [case["reference"]["split_half"] for case in records["accuracy"]["cells"]]
        rows.append(["Correlation of the entropy with path tracing, noise of 8 % (`fixed`)",
                     both(row["pearson"] for row in fixed),
                     f"{mean(halves):.3f}: path tracing against itself"])  # fmt: skip
    if found := rows_of(records.get("calibration", {"cells": []}), "default"):
        shares = {name: [row[f"interval {name}"] for row in found] for name in "rmc"}
        traced = rows_of(records["calibration"], "traced")
        rows += [
            ["The same with estimated noise (`default`)", both(row["rho now"] for row in traced),
             f"{mean(row['halves'] for row in traced):.2f}: path tracing against itself"],
            ["90 % intervals that contain the truth: roughness, metallic, base colour",
             ", ".join(f"{mean(values):.2f}" for values in shares.values()), ".90"],
        ]  # fmt: skip
    if "speed" in records:
        parts = records["speed"]["cells"][0]["rows"]
        way, brute = parts["whole_way"]["angular"], seconds(parts["brute"]["seconds"])
        rows += [
            ["Time from 60 photographs of 512 x 512 to entropy.exr of 512 x 512 texels",
             seconds(way["warm"]["seconds"]["median"]), f"{brute} by path tracing"],
        ]  # fmt: skip
    if "recovery" in records:
        found = [rows_of(records["recovery"], way.label) for way in (SH, PATH)]
        psnr = [mean(row["psnr"]["average"] for row in results) for results in found]
        time = [seconds(mean(row["seconds"] for row in results)) for results in found]
        rows.append(["Average PSNR of recovered textures; time",
                     f"{psnr[0]:.1f} dB; {time[0]}",
                     f"{psnr[1]:.1f} dB; {time[1]} by path tracing"])  # fmt: skip
    return rows


def machines(records: dict[str, Record]) -> str:
    """Return a sentence on the machine, and which studies ran elsewhere or with other code."""
    places: dict[str, list[str]] = {}
    for name, record in records.items():
        place = record["environment"]
        memory = place.get("memory_gib")
        versions = {"Python": "python", "Mitsuba": "mitsuba", "Dr.Jit": "drjit", "NumPy": "numpy"}
        words = [place.get("cpu") or "unknown CPU", f"{place['processors']} cores",
                 f"{memory:.0f} GiB of memory" if memory else "unknown memory", place["platform"],
                 *(f"{title} {place['versions'][key]}" for title, key in versions.items()),
                 f"LLVM {place['llvm']['version']}", f"variant `{place['variant']}`"]  # fmt: skip
        places.setdefault(", ".join(words), []).append(name)
    codes: dict[str, list[str]] = {}
    for name, record in records.items():
        codes.setdefault(", ".join(record["code"]), []).append(name)
    lines = [f"{', '.join(names)}: {place}." if len(places) > 1 else f"Machine: {place}."
             for place, names in places.items()]  # fmt: skip
    if len(codes) == 1:
        lines.append(f"All studies ran with one version of the code (digest {next(iter(codes))}).")
    else:
        lines += [f"Code {code}: {', '.join(names)}." for code, names in codes.items()]
    quick = [name for name, record in records.items() if record["quick"]]
    lines += [f"Quick sizes, not comparable: {', '.join(quick)}."] if quick else []
    dates = sorted(record["date"][:10] for record in records.values())
    return " ".join([*lines, f"Measured {' to '.join(dict.fromkeys((dates[0], dates[-1])))}."])


def section_text(section: Section, records: dict[str, Record]) -> str:
    """Return a section: commands, text and table."""
    rows, commands = [], []
    for name, find in section.rows.items():
        if name not in records:
            commands.append(f"`svu bench {name}`: not measured.")
            continue
        record = records[name]
        rows += [[re.sub(r"[+]?\bnan\b", "-", cell) for cell in row] for row in find(record)]
        commands.append(f"`{record['command']}` (cases: {len(record['cells'])}; "
                        f"[all tables](notebooks/benchmarks/{name}.md)).")  # fmt: skip
    parts = [f"## {section.title}\n{section.text} {' '.join(commands)}"]
    parts += [table(section.heads, rows)] if rows else []
    if section.picture and rows:
        parts.append(f"![{section.title}](notebooks/benchmarks/{section.picture}.png)")
    return "\n\n".join(parts)


def overview(records: dict[str, Record]) -> str:
    """Return BENCHMARKS.md."""
    parts = [
        "# Benchmarks",
        "Written by `python notebooks/write_benchmarks.py` from `notebooks/benchmarks/*.json`, the "
        "records of `svu bench`; do not edit. A case is an object under a light, photographed "
        "60 times. Numbers in brackets are of the worst case.",
    ]
    if records:
        parts.append(machines(records))
    if rows := short(records):
        parts += ["## How accurate and how fast is the default?",
                  table(("quantity", "measured", "compare with"), rows)]  # fmt: skip
    return "\n\n".join([*parts, *(section_text(section, records) for section in SECTIONS)]) + "\n"


def study_page(record: Record, pictures: Iterable[str]) -> str:
    """Return the page of a study: all of its tables and plots."""
    images = (f"![{name}]({name}.png)" for name in pictures)
    parts = [study_of(record["study"]).markdown(record), provenance(record), *images]
    return "\n\n".join(parts) + "\n"


def read_all(folder: Path = FOLDER) -> dict[str, Record]:
    """Read the records of all measured studies, in the order of ``BENCHMARKS``."""
    paths = {name: folder / f"{name}.json" for name in BENCHMARKS}
    return {name: read_record(path) for name, path in paths.items() if path.is_file()}


def texts(records: dict[str, Record]) -> dict[Path, str]:
    """Return the content of all pages by path."""
    pages = {ROOT / "BENCHMARKS.md": overview(records)}
    for name, record in records.items():
        pictures = [file for file in study_of(name).plots if (FOLDER / f"{file}.png").is_file()]
        pages[FOLDER / f"{name}.md"] = study_page(record, pictures)
    return pages


def rounded(value: Any) -> Any:
    """Return a JSON value with fewer digits, and with fewer points of scatter plots."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, list):
        if len(value) > LONG and isinstance(value[0], float):
            return [item if item is None else float(f"{item:.{FEW}g}") for item in value]
        return [rounded(item) for item in value]
    if isinstance(value, dict):
        points = {k: v[::THINNED] for k, v in value.items() if k == "entropy" and len_of(v) > LONG}
        return {k: rounded(v) for k, v in {**value, **points}.items()}
    return value


def len_of(value: Any) -> int:
    """Return the length of a list; 0 for other values."""
    return len(value) if isinstance(value, list) else 0


def copy(source: Path) -> None:
    """Copy the records of a folder, without spaces and with rounded numbers."""
    for name in BENCHMARKS:
        if (source / f"{name}.json").is_file():
            record = json.loads((source / f"{name}.json").read_text(encoding="utf-8"))
            record = rounded({key: record[key] for key in record if key not in DERIVED})
            text = json.dumps(record, separators=(",", ":"), ensure_ascii=False)
            (FOLDER / f"{name}.json").write_text(f"{text}\n", encoding="utf-8")


def main(source: Path | None = None) -> None:
    """Copy records, and write all pages and plots from them."""
    FOLDER.mkdir(exist_ok=True)
    if source is not None:
        copy(source)
    for old in (*FOLDER.glob("*.md"), *FOLDER.glob("*.png")):
        old.unlink()
    records = read_all()
    for file, figure in figures(records):
        figure.savefig(FOLDER / f"{file}.png", dpi=DPI)
    for path, text in texts(records).items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
