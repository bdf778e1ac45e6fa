"""Whether the tests notice faults: PYTHONPATH=tests python -m studies.faults [--only NAME ...].

Runs in the sources themselves: leave them alone meanwhile.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import tyro
from rich.console import Console
from studies.faults.faults import FAULTS
from studies.faults.run import source, table, try_out


@dataclass(frozen=True)
class Options:
    """Plant faults one by one, and tell which test notices each."""

    only: tuple[str, ...] = ()
    """Names of faults; all by default."""


def main(only: tuple[str, ...]) -> int:
    """Plant the faults of these names, or all; return how many no test has noticed."""
    unknown = set(only) - {fault.name for fault in FAULTS}
    if unknown:
        raise SystemExit(f"--only: there is no fault {', '.join(sorted(unknown))}.")
    console, outcomes = Console(stderr=True, soft_wrap=True), []
    chosen = [fault for fault in FAULTS if not only or fault.name in only]
    for fault in chosen:
        source(fault)  # all of them, before the first takes its time
    for fault in chosen:
        outcome = try_out(fault)
        console.print(f"{fault.name}: {outcome.test or 'not caught'} ({outcome.seconds:.0f} s)")
        outcomes.append(outcome)
    sys.stdout.write(table(outcomes) + "\n")
    return sum(one.test is None for one in outcomes)


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options).only))
