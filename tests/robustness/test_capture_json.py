"""``capture.json``: every field has a type and a range, and the message names it."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
from support import fuzz_formats

from svu_mi.capture import capture_folder
from svu_mi.capture.loading import load_capture
from svu_mi.capture.sensors import check_record, make_sensor
from svu_mi.core.validation import MAX_VIEWS, require_views
from svu_mi.errors import CaptureError, OptionError, SceneError


@pytest.fixture
def capture(tmp_path):
    fuzz_formats.write_scene_capture(tmp_path)
    return tmp_path


def edited(folder, changes):
    """Change fields, given as path of keys and value."""
    path = folder / "capture.json"
    record = json.loads(path.read_text())
    for keys, value in changes.items():
        holder = record
        *way, last = keys.split("/")
        for key in way:
            holder = holder[int(key) if key.isdigit() else key]
        holder[int(last) if isinstance(holder, list) else last] = value
    path.write_text(json.dumps(record))
    return path


SENSOR = "sensors/0/"
BAD = {
    "format": {"format": "other"}, "version": {"version": 99}, "exposure 0": {"exposure": [1, 0]},
    "exposure of one view": {"exposure": [1]}, "scene": {"scene": 3},
    "scene of nothing": {"scene": "x" * 3000}, "scene of a folder": {"scene": ".."},
    "scene of accounts": {"scene": "/etc/passwd"}, "define": {"define": [1]},
    "define of lists": {"define": {"a": [1]}}, "shape": {"shape": 3}, "import": {"import": 3},
    "define of 10^400": {"define": {"a": 10**400}}, "define of inf": {"define": {"a": np.inf}},
    "define of 2e30": {"define": {"a": 2e30}},
    "exposure": {"exposure": 2}, "exposure of text": {"exposure": ["1", "2"]},
    "exposure True": {"exposure": [True, 1e-40]}, "exposure 10^400": {"exposure": [10**400, 1]},
    "sensors": {"sensors": {"a": 1}}, "sensors of text": {"sensors": ["a"]},
    "to_world": {SENSOR + "to_world": np.eye(3).tolist()},
    "to_world of text": {SENSOR + "to_world/0/0": "1"},
    "to_world of NaN": {SENSOR + "to_world/1/1": float("nan")},
    "to_world huge": {SENSOR + "to_world/1/3": 10**400},
    "x_fov": {SENSOR + "x_fov": [35]}, "x_fov 0": {SENSOR + "x_fov": 0},
    "x_fov 180": {SENSOR + "x_fov": 180}, "x_fov True": {SENSOR + "x_fov": True},
    "clip": {SENSOR + "clip": [1, 2, 3]}, "clip turned": {SENSOR + "clip": [2, 1]},
    "clip negative": {SENSOR + "clip": [-1, 1]}, "film": {SENSOR + "film": [16.5, 8]},
    "film of nothing": {SENSOR + "film": [0, 8]}, "film of text": {SENSOR + "film": "ab"},
    "film, large": {SENSOR + "film": [32769, 32768], SENSOR + "crop_size": [32769, 32768]},
    "film, long": {SENSOR + "film": [2**31, 1], SENSOR + "crop_size": [2**31, 1]},
    "crop_size": {SENSOR + "crop_size": [17, 8]}, "crop_offset": {SENSOR + "crop_offset": [-1, 0]},
    "principal_point_offset": {SENSOR + "principal_point_offset": None},
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_each_field_is_refused_by_its_name(capture, case):
    path = edited(capture, BAD[case])
    with pytest.raises((CaptureError, SceneError)) as caught:
        load_capture(capture)
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: ") and "\n" not in sentence
    key = case.split()[0].rstrip(",").removesuffix("s").replace("crop_offset", "crop_")
    assert key in sentence and len(sentence.replace(str(capture), "")) < 400


@pytest.mark.parametrize("key", ["to_world", "x_fov", "clip", "film", "crop_size", "crop_offset"])
def test_a_field_that_is_missing_is_named(capture, key):
    path = capture / "capture.json"
    record = json.loads(path.read_text())
    del record["sensors"][1][key]
    path.write_text(json.dumps(record))
    with pytest.raises(CaptureError, match=rf"capture.json: sensor 1: {key} is missing; render"):
        load_capture(capture)


def test_unknown_keys_are_ignored(capture):
    edited(capture, {"files": {"a": 1}, "id": "x", "written": None, SENSOR + "comment": "window"})
    assert load_capture(capture).count == 2


def test_numbers_are_fine_where_text_is_expected_of_parameters(capture):
    edited(capture, {"define": {"a": 1, "b": 0.5, "c": True, "d": "x"}})
    description = capture_folder.read(capture)
    assert description.defines == {"a": "1", "b": "0.5", "c": "True", "d": "x"}


def test_more_sensors_than_the_limit_are_refused_at_once(capture):
    path = capture / "capture.json"
    record = json.loads(path.read_text())
    text = json.dumps({**record, "sensors": record["sensors"] * 5_001})
    path.write_text(text)
    started = time.process_time()
    json.loads(text)  # nothing is done but this, about twice as slow beside other work
    parsed = time.process_time()
    with pytest.raises(
        CaptureError, match="sensors must be objects for 0 to 10000 cameras, got a list of"
    ):
        load_capture(capture)
    assert time.process_time() - parsed < 4 * (parsed - started) + 0.5


def test_the_most_sensors_that_are_rendered_can_be_read(capture):
    """``view_9999`` is the last name of a photograph."""
    path = capture / "capture.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps({**record, "sensors": record["sensors"] * (MAX_VIEWS // 2)}))
    assert len(capture_folder.read(capture).sensors) == MAX_VIEWS
    with pytest.raises(OptionError, match="--views: at most 10000 are supported, got 10001"):
        require_views(MAX_VIEWS + 1, "--views")


def test_too_large_capture_json_is_not_read(capture):
    path = capture / "capture.json"
    with path.open("r+b") as stream:
        stream.truncate(2**27)
    with pytest.raises(CaptureError, match="file: it has more than 64 MiB"):
        load_capture(capture)


def test_deep_json_is_refused(capture):
    (capture / "capture.json").write_text('{"format": ' + "[" * 200_000)
    with pytest.raises(CaptureError, match="capture.json: not a readable JSON file"):
        load_capture(capture)


def test_arrays_and_their_numbers_are_welcome_in_a_description():
    record = {
        "to_world": np.eye(4, dtype=np.float32), "x_fov": np.float32(35),
        "principal_point_offset": (np.float64(0.1), 0), "clip": np.array([0.1, 10.0]),
        "film": np.array([16, 8]), "crop_offset": (0, np.int64(0)), "crop_size": (16, 8),
    }  # fmt: skip
    assert make_sensor(record, "any").film().size()[0] == 16
    largest = (32768, 32768)
    check_record({**record, "film": largest, "crop_size": largest}, "any")
