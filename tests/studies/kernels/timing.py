"""Run times that only the kernels' study asks for: in turns, and of compilation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from svu_mi.bench.clock import WARM_UP, run, summary

UNITS = {"microseconds": 1e6, "nanoseconds": 1e9}  # in a second


def measure_in_turns(
    functions: Mapping[str, Callable[[], Any]], repeats: int
) -> dict[str, dict[str, Any]]:
    """Time functions that are to be compared: a slow spell of the machine then hits them all.

    Args:
        functions: by name, each as for ``clock.run``.
        repeats: number of runs of each that count.

    Returns:
        What ``clock.measure`` returns, by name.
    """
    rounds = [
        {name: run(function) for name, function in functions.items()}
        for _ in range(WARM_UP + repeats)
    ]
    return {name: summary([one[name] for one in rounds[WARM_UP:]]) for name in functions}


def compile_record(function: Callable[[], Any]) -> dict[str, Any]:
    """Return what it costs to run a function for the first time in a process.

    Returns:
        ``seconds`` of the backend, ``compiled`` kernels, ``operations`` of all kernels.
    """
    first = run(function)
    return {"seconds": first.compile, "compiled": first.compiled, "operations": first.operations}


def per_texel(label: str, timed: Mapping[str, Any], texels: int, unit: str) -> dict[str, Any]:
    """Return what a row of a table says of run times.

    Args:
        label: of the row.
        timed: what ``clock.measure`` returns.
        texels: how many were worked on at a time.
        unit: ``microseconds`` or ``nanoseconds`` of one texel.
    """

    def scaled(seconds: Mapping[str, float]) -> dict[str, float]:
        return {name: UNITS[unit] / texels * value for name, value in seconds.items()}

    return {
        "label": label,
        "texels": texels,
        unit: scaled(timed["kernel"]),
        f"wall_{unit}": scaled(timed["wall"]),
        "launched": timed["launched"],
        "operations": timed["operations"],
    }
