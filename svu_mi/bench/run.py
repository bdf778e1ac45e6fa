"""Run benchmarks and write what they found."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

from svu_mi.bench import BENCHMARKS
from svu_mi.bench.experiment import Bench, Record
from svu_mi.bench.plots import save
from svu_mi.bench.study import Asked, Study, how_it_was_run, told_how
from svu_mi.errors import OptionError
from svu_mi.files import prepare_folder, write_text
from svu_mi.output import write_manifest
from svu_mi.settings import require_known


def run_bench(
    bench: Bench, names: Sequence[str], asked: Asked, command: str = ""
) -> dict[str, Any]:
    """Run benchmarks, one after another, and write bench.json, bench.md and the plots.

    Tables of all that is known so far are written after each cell.

    Args:
        bench: where and how.
        names: of ``BENCHMARKS``.
        asked: what of them is run.
        command: as the user gave it, for the record.

    Returns:
        What bench.json holds: how it was run, ``settings``, and a record by name
        (``Study.run``).

    Raises:
        OptionError: an unknown benchmark, or no cell.
        SvuError: that of the first cell of a benchmark, if all its cells failed.
        OutputError: the folder cannot be written.
    """
    require_known(names, BENCHMARKS, "benchmark")
    wanted = {name: import_module(f"svu_mi.bench.{name}").STUDY for name in names}
    if not asked.cells and any(study.on_cells for study in wanted.values()):
        raise OptionError("There is no object and light to run; change --objects or --lights.")
    if asked.capture is None and not all(study.on_cells for study in wanted.values()):
        raise OptionError("There is no capture to run on; give its folder.")
    prepare_folder(bench.folder)
    record = {**how_it_was_run(command), "settings": bench.sizes}
    studies: dict[str, Study] = {}
    for name, study in wanted.items():
        studies[name] = study

        def told(found: Record, name: str = name) -> None:
            record[name] = found
            write(bench, record, studies)

        told(study.run(bench, asked, told))
        draw(bench, record, studies)
    return record


def write(bench: Bench, record: Record, studies: dict[str, Study]) -> None:
    """Write bench.json and bench.md with what is known so far."""
    write_manifest(bench.folder / "bench.json", record)
    sizes = [_sizes(bench)] if any(study.on_cells for study in studies.values()) else []
    parts = ["# Benchmark", told_how(record), *sizes]
    parts += [study.markdown(record[name]) for name, study in studies.items() if name in record]
    write_text(bench.folder / "bench.md", "\n\n".join(parts))


def draw(bench: Bench, record: Record, studies: dict[str, Study]) -> None:
    """Draw the plots of all benchmarks that found anything: some show several of them."""
    found = {name: record[name] for name in studies if record[name]["cells"]}
    with bench.progress.stage("Drawing plots"):
        for name in found:
            for file, plot in studies[name].plots.items():
                if (figure := plot(found)) is not None:
                    save(figure, bench.folder, file)


def _sizes(bench: Bench) -> str:
    size = bench.sizes
    return (
        f"{size.views} photographs of {size.film} x {size.film} with {size.spp} samples per "
        f"pixel, {size.texels} x {size.texels} texels, reference on {size.reference_texels} "
        f"texels with {size.reference_spp} samples."
    )
