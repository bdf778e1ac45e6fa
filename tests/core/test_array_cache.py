"""Arrays that are kept in a folder: by their key, within a limit, by many processes."""

from __future__ import annotations

import os
import random

import numpy as np
import pytest
from support.helpers import Said, names
from support.kills import kill_while_keeping

from svu_mi.core import code_digest
from svu_mi.core.io.array_cache import ArrayCache
from svu_mi.core.io.npz import read_arrays, write_arrays


def keep(cache: ArrayCache, value: float, name: str = "squares", size: int = 1000) -> list[str]:
    """Ask for an array of a value; return the kinds of results that were computed for it."""
    computed = []

    def compute() -> np.ndarray:
        computed.append(name)
        return np.full(size, value)

    def restore(arrays):
        if set(arrays) != {"x"}:
            raise ValueError("other names")
        return arrays["x"]

    found = cache.recall(name, [value], compute, lambda x: {"x": x}, restore)
    np.testing.assert_array_equal(found, np.full(size, value))
    return computed


def test_a_result_is_computed_once_for_equal_inputs(tmp_path):
    cache = ArrayCache(tmp_path / "cache")
    assert keep(cache, 2.0) == ["squares"] and keep(cache, 2.0) == []
    assert keep(cache, 3.0) == ["squares"] and keep(cache, 2.0, "roots") == ["roots"]
    assert keep(cache.under("another capture"), 2.0) == ["squares"]
    assert keep(cache.under("another capture"), 2.0) == []
    assert len(names(tmp_path / "cache")) == 4


def test_nothing_is_kept_without_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert keep(ArrayCache(), 2.0) == keep(ArrayCache(), 2.0) == ["squares"]
    assert names(tmp_path) == []


@pytest.mark.parametrize("change", ["version", "code"])
def test_another_version_or_an_edited_kernel_computes_again(tmp_path, monkeypatch, change):
    keep(ArrayCache(tmp_path), 2.0)
    if change == "version":
        monkeypatch.setattr(code_digest.dr, "__version__", "1.5.1")
    else:
        (tmp_path / "svu_mi" / "light").mkdir(parents=True)
        (tmp_path / "svu_mi" / "light" / "kernel.py").write_text("x = 1")
        monkeypatch.setattr(code_digest.svu_mi, "__file__", str(tmp_path / "svu_mi/__init__.py"))
        code_digest.digest_of_sources.cache_clear()
    assert keep(ArrayCache(tmp_path), 2.0) == ["squares"]
    code_digest.digest_of_sources.cache_clear()


@pytest.mark.parametrize("damage", ["cut", "empty", "bit", "other arrays", "folder"])
def test_a_damaged_file_is_computed_again_and_replaced(tmp_path, damage):
    cache = ArrayCache(tmp_path / "cache", progress=Said())
    keep(cache, 2.0)
    (path,) = (tmp_path / "cache").iterdir()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    if damage == "other arrays":
        write_arrays(path, {"y": np.zeros(3)})
    elif damage == "folder":
        path.unlink()
        path.mkdir()
    else:
        path.write_bytes({"cut": data[:500], "empty": b"", "bit": data}[damage])
    assert keep(cache, 2.0) == ["squares"]
    assert keep(cache, 2.0) == (["squares"] if damage == "folder" else [])


def test_the_least_recently_used_files_are_removed(tmp_path):
    cache = ArrayCache(tmp_path, limit=27_000)  # room for three arrays of 8000 bytes
    (tmp_path / "notes.npz").write_bytes(bytes(20_000))
    for age, value in ((300, 1.0), (200, 2.0), (100, 3.0)):
        keep(cache, value)
        newest = max(tmp_path.glob("squares*"), key=lambda path: path.stat().st_mtime)
        os.utime(newest, (newest.stat().st_mtime - age,) * 2)
    assert keep(cache, 1.0) == []  # now the most recently used one
    keep(cache, 4.0)
    assert keep(cache, 1.0) == keep(cache, 4.0) == [] and keep(cache, 2.0) == ["squares"]
    assert "notes.npz" in names(tmp_path)


def test_what_exceeds_the_limit_is_not_kept(tmp_path):
    said = Said()
    cache = ArrayCache(tmp_path / "cache", limit=7000, progress=said)
    assert keep(cache, 1.0) == keep(cache, 1.0) == ["squares"]
    assert not (tmp_path / "cache").exists()
    assert said.lines == [f"{tmp_path / 'cache'}: 8 kB of squares exceed the limit; not kept."] * 2


def test_a_folder_that_cannot_be_written_is_announced(tmp_path):
    (tmp_path / "cache").write_text("mine")
    said = Said()
    assert keep(ArrayCache(tmp_path / "cache", progress=said), 1.0) == ["squares"]
    (line,) = said.lines
    assert line.startswith("Nothing is kept for other commands: ") and "is a file" in line
    assert (tmp_path / "cache").read_text() == "mine"


def test_size_and_folder_are_announced(tmp_path):
    said = Said()
    keep(ArrayCache(tmp_path, progress=said), 1.0, size=2_600_000)
    assert said.lines == [f"Kept squares in {tmp_path} for other commands: 21 MB"]


@pytest.mark.parametrize("kill", range(6))
def test_a_kill_while_it_is_written_loses_nothing(tmp_path, kill):
    kill_while_keeping(tmp_path / "cache", random.Random(kill), size=2**20)


@pytest.mark.forks
def test_several_processes_keep_and_read_at_once(tmp_path):
    children = []
    for child in range(4):
        if (pid := os.fork()) == 0:
            chance, code = random.Random(child), 1
            try:
                for _ in range(30):  # more values than there is room for
                    keep(ArrayCache(tmp_path, limit=27_000), float(chance.randrange(6)))
                code = 0
            finally:
                os._exit(code)
        children.append(pid)
    assert [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in children] == [0] * 4
    for path in tmp_path.glob("squares*"):
        assert set(read_arrays(path)) == {"x"}
    keep(ArrayCache(tmp_path), 9.0)
    assert not [name for name in names(tmp_path) if name.startswith(".")]
