"""Kill commands, and let them meet: PYTHONPATH=tests python -m studies.kills [--kills N].

Prints a table of what was left behind; ``tests/trust/test_trust_kills.py`` runs a few of each.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import svu_mi  # noqa: F401 - chooses LLVM before Dr.Jit is imported

# isort: split
import mitsuba as mi

from studies.kills.run import COMMANDS, Place, killed, met, prepare


def main() -> None:
    """Kill, and let meet, as often as asked; print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--pairs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=19)
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    chance, names = random.Random(options.seed), list(COMMANDS)
    with tempfile.TemporaryDirectory(prefix="svu-kills-") as folder:
        at = Path(folder)
        os.environ.setdefault("DRJIT_CACHE_DIR", str(at / "kernels"))
        prepare(at)
        places = {name: Place(name, at).begin() for name in names}
        left, pairs = ({name: Counter[str]() for name in names} for _ in range(2))
        for index in range(options.kills):
            place = places[names[index % len(names)]]
            left[place.name][_found(killed, place, chance, at / "again" / place.name)] += 1
        for index in range(options.pairs):
            place = places[names[index % len(names)]]
            pairs[place.name][_found(met, place, at / "again" / place.name)] += 1
    print("| command | s | killed | old | new | wrong | met | one wrote | in turn | wrong |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in names:
        a, b = left[name], pairs[name]
        wrong = [sum(c.values()) - sum(c[k] for k in ("old", "new", "one", "both")) for c in (a, b)]
        print(f"| `{name}` | {places[name].seconds:.1f} | {a.total()} | {a['old']} | {a['new']} | "
              f"{wrong[0]} | {b.total()} | {b['one']} | {b['both']} | {wrong[1]} |")  # fmt: skip


def _found(attempt: Callable[..., str], *arguments: Any) -> str:
    try:
        return attempt(*arguments)
    except Exception as error:  # whatever it is, it is counted
        print(f"wrong: {type(error).__name__}: {error}", file=sys.stderr)
        return "wrong"


if __name__ == "__main__":
    main()
