"""``svu bench verdict``: are captures with a mistake called unreliable, and is its cause named?

Each case is estimated as it is, and with some of nine mistakes (``spoiled_captures``): twelve cases
have three captures of each. Every second case has masks. Photographs are small, as R^2 of a
sample of 800 texels hardly depends on their size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, NamedTuple

from svu_mi.bench import spoiled_captures as spoiled
from svu_mi.bench.cases import Case, chosen_cases
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Measurement, Record
from svu_mi.bench.markdown import Bar, Column, digits, tabulate
from svu_mi.bench.study import Selection, Study
from svu_mi.capture.capture import Capture
from svu_mi.capture.scene import find_environment, load_scene
from svu_mi.geometry.texels import texels
from svu_mi.pipeline import estimate

SIZES: dict[str, Any] = {"views": 30, "film": 96, "spp": 32}
QUICK: dict[str, Any] = {"views": 16, "film": 48, "spp": 4}
TEXELS, QUICK_TEXELS = 96, 32  # per side
SPP = 16  # of photographs of tables and turntables
SOUND = "sound"
TABLES = ((0.7, 0.7, 0.7), (0.5, 0.3, 0.15), (0.8, 0.75, 0.7))
EVERY = 4  # one case of four has a mistake


class Mistake(NamedTuple):
    """A mistake: the cause to be named, and a function of a case and the degree (0, 1 or 2)."""

    cause: str
    made: Callable[[VerdictCase, int], Capture]


MISTAKES = {
    "foreign mesh": Mistake("mesh", lambda case, _: spoiled.foreign_mesh(case.capture, case.other)),
    "turned mesh": Mistake(
        "poses", lambda case, k: spoiled.turned_mesh(case.capture, (5, 10, 20)[k])
    ),
    "moved mesh": Mistake(
        "poses", lambda case, k: spoiled.moved_mesh(case.capture, (0.03, 0.05, 0.1)[k])
    ),
    "wrong light": Mistake(
        "light",
        lambda case, k: spoiled.other_light(case.capture, case.other_light, (0, 90, 180)[k]),
    ),
    "table": Mistake(
        "surroundings", lambda case, k: spoiled.on_table(case.capture, TABLES[k], SPP)
    ),
    "turning light": Mistake(
        "turning light", lambda case, _: spoiled.on_turntable(case.capture, SPP)
    ),
    "wrong poses": Mistake(
        "poses", lambda case, k: spoiled.wrong_poses(case.capture, (0.5, 1, 2)[k], k)
    ),
    "other object": Mistake(
        "objects", lambda case, _: spoiled.half_of_another(case.capture, case.other)
    ),
    "gains": Mistake("gains", lambda case, k: spoiled.with_gains(case.capture, seed=k)),
}


@dataclass(frozen=True)
class VerdictCase(CaseSubject):
    """A case that is estimated as it is, and with mistakes.

    Attributes:
        number: index of the case, which selects its mistakes.
        near: cases with another object under its light, and with its object under another light.
    """

    number: int
    near: tuple[Case, Case]

    @property
    def rows(self) -> tuple[Measurement, ...]:
        degree, shifted = self.number // EVERY % 3, self.number + self.number // EVERY
        chosen = [name for k, name in enumerate(MISTAKES) if (shifted + k) % EVERY == 0]
        sound = Measurement(SOUND, lambda self: self.judged(self.capture, ""))
        return sound, *(_spoiled(name, degree) for name in chosen)

    def _photographs(self, case: Case) -> Capture:
        sizes = QUICK if self.bench.quick else SIZES
        return self.bench.capture(case, "verdict", **sizes)

    @cached_property
    def capture(self) -> Capture:
        """Photographs of the case."""
        return self._photographs(self.case)

    @property
    def other(self) -> Capture:
        """Photographs of another object in this light."""
        return self._photographs(self.near[0])

    @property
    def other_light(self) -> Any:
        """Another light."""
        case = self.near[1]
        return find_environment(load_scene(case.scene, case.defines), str(case.scene))

    def judged(self, capture: Capture, expected: str) -> Record:
        """Return the prediction of held-out photographs, and the expected cause."""
        if self.number % 2:
            capture = spoiled.without_masks(capture)
        layout = texels(capture.mesh, QUICK_TEXELS if self.bench.quick else TEXELS)
        found = estimate(capture, layout).prediction
        if found is None:
            return {"expected": expected, "reliable": None, "cause": ""}
        shown = {name: value for name, value in asdict(found).items()
                 if name not in ("photographs", "sides")}  # fmt: skip
        return {**shown, "expected": expected, "reliable": found.reliable}


def _spoiled(name: str, degree: int) -> Measurement:
    """Return the row of a mistake."""
    mistake = MISTAKES[name]
    return Measurement(name, lambda case: case.judged(mistake.made(case, degree), mistake.cause))


def _lines(record: Record) -> list[Record]:
    return [{"case": cell["cell"], "row": label, **row}
            for cell in record["cells"] for label, row in cell["rows"].items()]  # fmt: skip


SHOWN = (
    Column("case", lambda line: line["case"]),
    Column("capture", lambda line: line["row"]),
    Column("R^2", lambda line: line.get("r2"), digits(2)),
    Column("means of texels", lambda line: line.get("r2_of_means"), digits(2)),
    Column("diffuse", lambda line: line.get("r2_of_diffuse"), digits(2)),
    Column("90 % intervals hold", lambda line: line.get("coverage"), digits(2)),
    Column("verdict", lambda line: "reliable" if line["reliable"] else "unreliable"),
    Column("named cause", lambda line: line["cause"]),
    Column("cause", lambda line: line["expected"]),
)


def bars(record: Record) -> list[Bar]:
    """Return the bars of a record of ``svu bench verdict``."""
    lines = _lines(record)
    sound = [line["reliable"] is not False for line in lines if line["row"] == SOUND]
    wrong = [line for line in lines if line["row"] != SOUND]
    found = [line["reliable"] is False for line in wrong]
    right = [bool(line["cause"]) and line["cause"] == line["expected"] for line in wrong]
    shares = {
        "sound captures that are called reliable": (sound, 1.0),
        "captures with a mistake that are called unreliable": (found, 22 / 27),
        "captures with a mistake whose cause is named": (right, 13 / 27),
    }
    return [Bar(what, sum(one) / max(len(one), 1), limit, least=True)
            for what, (one, limit) in shares.items()]  # fmt: skip


def experiment(bench: BenchRun, selection: Selection) -> Experiment:
    """Return the experiment: cases as they are, and with mistakes."""
    subjects = []
    for number, case in enumerate(selection.cases):
        beside = chosen_cases(selection.data, bench.folder, lights=[case.light])
        under = chosen_cases(selection.data, bench.folder, objects=[case.object])
        objects, lights = [one.object for one in beside], [one.light for one in under]
        near = (beside[(objects.index(case.object) + 1) % len(beside)],
                under[(lights.index(case.light) + 1) % len(under)])  # fmt: skip
        subjects.append(VerdictCase(bench, case, number, near))
    return Experiment("verdict", subjects)


STUDY = Study(title="Captures with mistakes", experiment=experiment, bars=bars, own_sizes=True,
              tables=lambda record: [tabulate(SHOWN, _lines(record))])  # fmt: skip
