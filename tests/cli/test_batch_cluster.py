"""``svu batch`` on a cluster of Dask workers."""

from __future__ import annotations

import faulthandler
import json
import shutil
import sys
from concurrent.futures import CancelledError
from unittest.mock import MagicMock

import numpy as np
import pytest
from support.helpers import run

from svu_mi import scenes
from svu_mi.cli.batch import runner
from svu_mi.core.io.exr import read_exr
from svu_mi.errors import SvuError

SIDE = 32


@pytest.fixture(scope="module")
def client():
    """Cluster of two workers with one thread each."""
    distributed = pytest.importorskip("distributed")

    def start():
        return distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        )

    try:
        started = start()
    except AssertionError:  # its thread started too late on a busy machine
        faulthandler.dump_traceback(sys.__stderr__)
        started = start()
    with started as workers, distributed.Client(workers) as client:
        yield client


@pytest.mark.parametrize("name", ["CommClosedError", "CancelledError"])
def test_a_connection_that_is_lost_is_a_sentence(monkeypatch, name):
    """Dask raises two exceptions: for results in transfer, and for unfinished work."""
    distributed = pytest.importorskip("distributed")
    known = {"CommClosedError": distributed.comm.CommClosedError, "CancelledError": CancelledError}
    monkeypatch.setattr(distributed, "Client", MagicMock())
    with pytest.raises(SvuError, match="connection was lost"), runner.dask_client("tcp://there:1"):
        raise known[name]("Stream is closed.")


@pytest.mark.slow
def test_captures_are_tasks_of_a_cluster(client, shot, tmp_path):
    """Results equal those of the command; a second run does nothing."""
    for name in ("a", "b", "broken"):
        folder = shutil.copytree(shot, tmp_path / "shelf" / name)
        record = json.loads((folder / "capture.json").read_text())
        record["scene"] = str(scenes.path("vase"))
        (folder / "capture.json").write_text(json.dumps(record))
    (tmp_path / "shelf" / "broken" / "view_0005.exr").write_bytes(b"no picture")
    words = ("batch", tmp_path / "shelf", "--steps", "entropy", "--resolution", SIDE)
    there = (*words, "--scheduler", client.scheduler.address, "-o", tmp_path / "there")
    assert run(*there) == 1
    here = ("entropy", tmp_path / "shelf" / "a", "--resolution", SIDE, "--no-pictures")
    assert run(*here, "-o", tmp_path / "here") == 0
    expected = read_exr(tmp_path / "here" / "entropy.exr")
    for name in ("a", "b"):
        found = read_exr(tmp_path / "there" / name / "entropy" / "entropy.exr")
        for channel, plane in expected.items():
            np.testing.assert_array_equal(found[channel], plane)
    table = (tmp_path / "there" / "index.csv").read_text()
    assert "view_0005.exr" in table and table.count("\n") == 4
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "there").rglob("entropy.exr")}
    assert run(*there) == 1
    assert before == {path: path.stat().st_mtime_ns for path in before}
