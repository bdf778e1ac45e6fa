"""The faults that ``studies.faults`` plants: still faults of what the sources say today."""

from __future__ import annotations

from pathlib import Path

import pytest
from studies.faults.faults import FAULTS, Fault
from studies.faults.run import ROOT, Outcome, planted, source, table


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_fault_can_be_planted(fault: Fault) -> None:
    text = source(fault)
    compile(text.replace(fault.right, fault.wrong), fault.file, "exec")
    assert fault.right != fault.wrong
    assert all((ROOT / "tests" / name).is_file() for name in fault.tests)


def test_there_are_twenty_of_several_kinds() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 20
    assert {"sign", "transpose", "off by one", "dropped weight", "wrong axis", "files"} <= {
        fault.kind for fault in FAULTS
    }


def test_a_planted_fault_is_taken_out_again(tmp_path: Path) -> None:
    fault, text = FAULTS[0], source(FAULTS[0])
    path = tmp_path / fault.file
    path.parent.mkdir(parents=True)
    path.write_text(text)
    with pytest.raises(KeyboardInterrupt), planted(fault, tmp_path):
        assert fault.wrong in path.read_text()
        raise KeyboardInterrupt
    assert path.read_text() == text


def test_a_fault_that_nothing_catches_stands_out() -> None:
    assert "**nothing**" in table([Outcome(FAULTS[0], None, 1.0)])
