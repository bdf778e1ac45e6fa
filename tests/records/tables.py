"""Print the tables of BENCHMARKS.md that compare two records.

    python tests/records/tables.py tests/records/80e66f7.json tests/records/one-model.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

BARS = {"rho": "rho", "rho of reference's halves": "halves", "roughness": "roughness",
        "metallic": "metallic", "base_color": "base colour"}  # fmt: skip


def table(heads: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def agreement(before: dict[str, Any], after: dict[str, Any]) -> str:
    """Entropy against path tracing and closed-form means, then and now."""
    rows = []
    for name, new in {**after["means"], **after["cells"]}.items():
        old = {**before["means"], **before["cells"]}[name]
        title = {"own": "**mean of 12 own**", "data": "**mean of 24 of DATA**"}.get(
            name, name.replace("__", " / ")
        )
        cells = [f"{old['rho']:.3f} -> {new['rho']:.3f}", f"{new[list(BARS)[1]]:.3f}"]
        cells += [f"{old[k]:.1f} -> {new[k]:.1f}" for k in list(BARS)[2:]]
        rows.append([title, *cells])
    return table(["object / light", *BARS.values()], rows)


def seconds(before: dict[str, Any], after: dict[str, Any]) -> str:
    """Run times, then and now."""
    return table(
        ["what", before["commit"], after["commit"]],
        [[k, f"{before['seconds'][k]:.2f}", f"{v:.2f}"] for k, v in after["seconds"].items()],
    )


def model(before: dict[str, Any], after: dict[str, Any]) -> str:
    """The reflection model against direct light, then and now: median, rms by lobe width."""
    rows = []
    for name, presets in after["model"].items():
        for title, found in (("then", before["model"][name]), ("now", presets["default"])):
            cells = [f"{100 * a:.1f} / {100 * b:.1f}" for a, b, _ in found.values()]
            rows.append([name.replace("__", " / "), title, *cells])
    heads = list(next(iter(before["model"].values())))
    return table(["object / light", "", *(f"alpha {head}" for head in heads)], rows)


def parser() -> argparse.ArgumentParser:
    """Return what this is asked."""
    found = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    found.add_argument("before", type=Path)
    found.add_argument("after", type=Path)
    return found


def main() -> None:
    """Print all tables."""
    asked = parser().parse_args()
    before, after = (json.loads(file.read_text()) for file in (asked.before, asked.after))
    for make in (model, agreement, seconds):
        print(make(before, after))


if __name__ == "__main__":
    main()
