"""The study of Stanford-ORB, capture by capture; what is finished is kept."""

from __future__ import annotations

from collections.abc import Iterator

from studies.orb.dataset import find_captures, own_dataset
from studies.orb.options import FULL, QUICK, Options
from studies.orb.setting import PLACE, Setting
from studies.orb.tables import orb_tables
from svu_mi.bench.experiment import Bench, Experiment, Record
from svu_mi.bench.study import Asked, Study


def orb_study(options: Options) -> Study:
    """Return what is measured: the textures of every capture are recovered, and pictures of them
    compared with photographs.

    Args:
        options: what of the data set is run; an unknown capture or row is an ``OptionError``.
    """

    def experiment(bench: Bench, asked: Asked) -> Experiment:
        del asked
        options.chosen_rows()
        data = own_dataset(bench) if options.data is None else options.data
        captures = options.chosen_captures(find_captures(data))
        sizes = options.sizes or (QUICK if bench.quick else FULL)

        def settings() -> Iterator[Setting]:
            for path in captures:
                yield Setting(bench, path, options, sizes)

        return Experiment(PLACE, settings(), whole=True)

    def summary(record: Record) -> Record:
        sizes = options.sizes or (QUICK if record["quick"] else FULL)
        return {**record, "sizes": sizes, "rendered": options.data is None}

    return Study(title="Stanford-ORB", experiment=experiment, tables=orb_tables, summary=summary)
