"""Checkpoints and cached references: damaged or forged ones are told, and cost no memory."""

from __future__ import annotations

import io
import json
import os
import warnings
import zipfile

import numpy as np
import pytest
from support import fuzz_records as rows
from support.helpers import peak_memory

from svu_mi.bench.result_cache import Store
from svu_mi.core.io.npz import DIGEST, read_arrays, write_arrays
from svu_mi.errors import OptionError, OutputError, SvuWarning
from svu_mi.evaluation import reference_cache
from svu_mi.recovery.checkpoint import Checkpoint

BOMB = 2**28  # bytes that a packed file of 256 KiB unpacks to


@pytest.fixture
def path(tmp_path):
    rows.write_checkpoint(tmp_path)
    return tmp_path / "checkpoint.npz"


def load(path):
    return Checkpoint(path, rows.SETTINGS, content=rows.CONTENT).load(rows.SHAPES)


def bomb(path):
    """Write an array that takes BOMB bytes, packed into a thousandth of that."""
    header = io.BytesIO()
    array = np.broadcast_to(np.float32(0), BOMB // 4)
    np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(array))
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("values/roughness.npy", "w") as member,
    ):
        member.write(header.getvalue())
        for _ in range(BOMB // 2**20):
            member.write(bytes(2**20))


def liar(path, shape):
    """Write an array whose header promises another shape than there is."""
    member = io.BytesIO()
    np.save(member, np.zeros(16, np.float32))
    told = member.getvalue().replace(b"(16,), }", shape.ljust(8), 1)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("losses.npy", told)


def test_a_packed_file_is_refused_before_it_is_unpacked(path):
    def refused():
        with pytest.raises(
            OutputError, match="damaged .an array has an unknown compression.; remove"
        ):
            load(path)

    bomb(path)
    assert path.stat().st_size < 2**21 and peak_memory(refused) < 2**22


def test_one_array_listed_three_times_is_refused_by_its_size(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("losses.npy", bytes(2**16))
        archive.filelist *= 3
    assert path.stat().st_size < 2 * 2**16
    with pytest.raises(OutputError, match=r"damaged .the arrays have more than 6\d{4} bytes"):
        load(path)


@pytest.mark.parametrize("shape", [b"(2**9,)}", b"(-16,),}", b"(10**9)}", b"(9**99,}", b"(8,), }"])
def test_array_longer_than_its_file_is_refused(path, shape):
    liar(path, shape)
    with pytest.raises(OutputError, match="checkpoint is damaged"):
        load(path)


def test_objects_are_never_unpickled(path):
    np.savez(path, step=np.array([print], object))
    with pytest.raises(OutputError, match="checkpoint is damaged .an array declares"):
        load(path)


def test_a_pipe_or_a_folder_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "folder.npz").mkdir()
    for name in ("pipe.npz", "folder.npz"):
        with pytest.raises(OutputError, match="damaged .the path is not a file"):
            load(tmp_path / name)


def test_what_is_written_is_read_again(tmp_path):
    arrays = {"a/b": np.arange(6.0).reshape(2, 3), "text": "ä", "none": np.zeros((0, 3)), "n": 3,
              "turned": np.asfortranarray(np.arange(6, dtype="f4").reshape(2, 3))}  # fmt: skip
    write_arrays(tmp_path / "a.npz", arrays)
    loaded = read_arrays(tmp_path / "a.npz")
    assert loaded.keys() == arrays.keys() and str(loaded["text"]) == "ä"
    for name in ("a/b", "none", "n", "turned"):
        np.testing.assert_array_equal(loaded[name], arrays[name])
        assert loaded[name].dtype == np.asarray(arrays[name]).dtype
    with np.load(tmp_path / "a.npz") as plain:
        assert DIGEST in plain.files


def test_replaced_array_is_detected(path):
    with np.load(path) as archive:
        arrays = dict(archive)
    arrays["step"] = np.array(2)
    np.savez(path, **arrays)
    with pytest.raises(OutputError, match="checksum does not match"):
        load(path)


FLOATS = np.full((4, 6, 1), 0.5, np.float32)
DEEP = "[" * 100_000
FORGED = {
    "step -1": ({"step": -1}, "step must be a whole number in [0, 2.14748e+09], got -1"),
    "step 10^9": ({"step": 10**9}, "losses must be 1000000000 numbers in "),
    "step 2.0": ({"step": 2.0}, "step must be a whole number in [0, 2.14748e+09], got 2.0"),
    "two steps": ({"step": [2, 2]}, "step"),
    "no step": ({"step": None}, "step"),
    "no format": ({"format": None}, "(format is missing)"),
    "no losses": ({"losses": None}, "(losses is missing)"),
    "losses of NaN": (
        {"losses": np.full(4, np.nan, np.float32)},
        "losses must be 4 numbers in [-3.4e+38, 3.4e+38], got nan",
    ),
    "double losses": ({"losses": np.zeros(4)}, "got float64 of shape (4,)"),
    "no values": ({"values/roughness": None}, "(values/roughness is missing)"),
    "shaped means": ({"first/roughness": FLOATS}, "first/roughness must be 24 numbers in"),
    "infinite": ({"values/roughness": FLOATS * np.float32(np.inf)}, "3.4e+38], got inf"),
    "text": ({"values/roughness": np.full((4, 6, 1), "a")}, "got <U1 of shape (4, 6, 1)"),
    "negative squares": (
        {"second/roughness": -FLOATS.ravel()},
        "second/roughness must be 24 numbers in [0, 3.4e+38], got -",
    ),
    "another array": ({"other": 1}, "(other is unknown)"),
    "settings of numbers": ({"settings": 3}, "settings must be a text, got 3"),
    "no JSON": ({"settings": "{"}, "Expecting"),
    "a list": ({"settings": "[]"}, "the settings are not a JSON object"),
    "deep": ({"settings": DEEP}, ""),
    "deep objects": ({"content": '{"a":' * 5000 + "1" + "}" * 5000}, ""),
}


@pytest.mark.parametrize("case", FORGED)
def test_every_field_is_checked_even_if_the_digest_matches(path, case):
    change, words = FORGED[case]
    arrays = read_arrays(path) | change
    write_arrays(path, {name: value for name, value in arrays.items() if value is not None})
    with pytest.raises(OutputError) as caught:
        load(path)
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: the checkpoint is damaged (") and words in sentence
    assert sentence.endswith("; remove it and start again.") and len(sentence) < 400


def test_foreign_words_are_shortened_and_printable(path):
    settings = {**rows.SETTINGS, "\x1b[31m" + "x" * 5000: "\n" * 5000}
    content = {"\x1b[31m" + "x" * 5000: "a"}
    for changes in ({"settings": settings}, {"content": content}):
        rows.write_checkpoint(path.parent)
        text = {name: json.dumps(value) for name, value in changes.items()}
        write_arrays(path, read_arrays(path) | text)
        with pytest.raises(OptionError, match="another run") as caught:
            load(path)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 700


def test_invalid_benchmark_record_is_computed_again(tmp_path):
    store = Store(tmp_path)
    for text in (DEEP, '{"key": "a"', "[]", '{"key": "b"}', "\0"):
        store.path("x").write_text(text)
        assert store.load("x", "a") is None
    store.path("x").unlink()
    store.path("x").mkdir()
    assert store.load("x", "a") is None


# --- references ----------------------------------------------------------------------------


@pytest.fixture
def reference(tmp_path):
    rows.write_reference(tmp_path)
    return tmp_path / rows.REFERENCE


def told(path):
    """Return the warning with which a cached reference is made again."""
    with pytest.warns(SvuWarning, match="it is traced again") as caught:
        assert reference_cache.load(path, rows.OPTIONS) is None
    return str(caught[0].message)


def test_a_sound_reference_is_taken(reference):
    with warnings.catch_warnings(action="error"):
        assert reference_cache.load(reference, rows.OPTIONS).count == 3


def test_a_packed_reference_is_not_unpacked(reference):
    bomb(reference)
    assert peak_memory(lambda: told(reference)) < 2**22


def test_a_reference_under_another_name_is_not_taken(reference):
    other = reference.with_name(f"reference-{'1b' * 16}.npz")
    reference.rename(other)
    assert "another capture" in told(other)


@pytest.mark.parametrize("name", ["tables", "subset", "coverage", "brightness", "unit", "rays"])
def test_a_reference_with_other_numbers_is_not_taken(reference, name):
    with np.load(reference) as archive:
        arrays = dict(archive)
    arrays[name] = arrays[name] + np.ones((), arrays[name].dtype)
    np.savez(reference, **arrays)
    assert "checksum does not match" in told(reference)
    del arrays[DIGEST]
    write_arrays(reference, {**arrays, name: np.stack([arrays[name]] * 2)})
    assert f"{name} must be " in told(reference) or name in ("subset", "coverage")
    write_arrays(reference, {k: v for k, v in arrays.items() if k != name})
    assert f"({name} is missing)" in told(reference)
