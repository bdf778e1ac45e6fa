"""A table of fields serves JSON and arrays: each deviation is named with its value and range."""

from __future__ import annotations

import numpy as np
import pytest

from svu_mi.core.io.schema import (
    FLAG,
    ITEMS,
    NAMES,
    NUMBER,
    OBJECT,
    TEXT,
    WHOLE,
    Axis,
    Field,
    checked,
    read_record,
)
from svu_mi.errors import CaptureError

TEXELS = Axis("texels", 1, 4)
SCHEMA = {
    "pose": Field(NUMBER, (2, 3), -10, 10, "units", None), "count": Field(WHOLE, (), 0, 9),
    "name": Field(TEXT, default="none"), "moves": Field(FLAG, default=False),
    "steps": Field({"seconds": Field(NUMBER, (), 0, 60, "seconds", 1)}, (NAMES,), default={}),
    "views": Field({"id": Field(TEXT)}, (Axis("views", 0, 2),), default=()),
    "numbers": Field(NUMBER, (ITEMS,), 0, 1, default=()), "rest": Field(OBJECT, default=None),
    "mean": Field("f", (TEXELS, 2), 0, 1e9, default=None),
    "seen": Field("f4", (TEXELS,), default=None),
}  # fmt: skip
FINE = {"count": 3}
NAN = float("nan")


def test_fields_are_returned_with_their_defaults():
    given = {"count": 3, "steps": {"a": {}}, "views": [{"id": "x", "more": 1}], "other": 1}
    assert checked({**given, "name": None}, SCHEMA) == {
        "pose": None, "count": 3, "name": "none", "moves": False, "steps": {"a": {"seconds": 1}},
        "views": [{"id": "x"}], "numbers": (), "rest": None, "mean": None, "seen": None,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"count": None}, "count is missing"),
        ({"count": 10}, "count must be a whole number in [0, 9], got 10"),
        ({"count": 3.0}, "count must be a whole number in [0, 9], got 3.0"),
        ({"count": True}, "count must be a whole number in [0, 9], got True"),
        ({"count": 10**400}, "count must be a whole number in [0, 9], got 1000000000"),
        ({"count": [3]}, "count must be a whole number in [0, 9], got a list of 1"),
        ({"pose": [[0, 0, 0]]}, "pose must be 2 x 3 numbers in [-10, 10] units, got a list of 1"),
        ({"pose": [[0, 0, 0], [0, 0, NAN]]}, "pose must be 2 x 3 numbers in [-10, 10] units, got"),
        ({"pose": [[0, 0, 0], [0, 0, None]]}, "got None"),
        ({"pose": [[0, 0, 0], "abc"]}, "got 'abc'"),
        ({"name": 3}, "name must be a text, got 3"),
        ({"moves": 1}, "moves must be true or false, got 1"),
        ({"steps": []}, "steps must be objects for each name, got a list of 0"),
        ({"steps": {"a": 3}}, "steps['a']: expected an object with seconds"),
        ({"steps": {"a": {"seconds": 61}}}, "steps['a']: seconds must be a number in [0, 60] sec"),
        ({"views": [{}]}, "views[0]: id is missing"),
        ({"views": [{"id": "x"}] * 3}, "views must be objects for 0 to 2 views, got a list of 3"),
        ({"numbers": [0, 2]}, "numbers[1] must be a number in [0, 1], got 2"),
        ({"numbers": {"a": 1}}, "numbers must be numbers for each entry in [0, 1], got {'a': 1}"),
        ({"rest": [1]}, "rest must be an object, got a list of 1"),
        ({"mean": np.zeros((5, 2))}, "mean must be numbers for 1 to 4 texels x 2 in [0, "),
        ({"mean": np.zeros((3, 2), int)}, "got int64 of shape (3, 2)"),
        ({"mean": np.full((3, 2), NAN)}, "for 3 texels x 2 in [0, 1e+09], got nan"),
        ({"mean": np.zeros((3, 2)), "seen": np.zeros(2, "f4")}, "seen must be numbers for 3 te"),
        ({"seen": np.zeros(2)}, "got float64 of shape (2,)"),
        ({"mean": np.full((3, 2), np.inf, "f2")}, "got inf"),
        ({"count": np.array(12)}, "count must be a whole number in [0, 9], got 12"),
    ],
)  # fmt: skip
def test_what_does_not_match_is_named(changes, sentence):
    with pytest.raises(ValueError) as caught:
        checked({**FINE, **changes}, SCHEMA)
    assert sentence in str(caught.value) and len(str(caught.value)) < 150


def test_other_fields_are_refused_where_none_may_be():
    assert checked({**FINE, "other": 1}, SCHEMA)["count"] == 3
    with pytest.raises(ValueError, match="other is unknown"):
        checked({**FINE, "other": 1}, SCHEMA, closed=True)
    for record in (None, [], 3, "text"):
        with pytest.raises(ValueError, match="expected an object with pose, count"):
            checked(record, SCHEMA)


def test_a_file_is_read_and_named(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"count": 3}')
    assert read_record(path, SCHEMA, "write it again")["count"] == 3
    path.write_text('{"count": NaN}')
    with pytest.raises(CaptureError, match=r"a\.json: count must .*, got nan; write it again\.$"):
        read_record(path, SCHEMA, "write it again")
    path.write_bytes(b"")
    with path.open("r+b") as file:
        file.truncate(2**27)  # a hole
    with pytest.raises(CaptureError, match=r"a\.json: .*more than 64 MiB"):
        read_record(path, SCHEMA, "write it again")
