"""The page of the plugins lists their parameters and defaults."""

from __future__ import annotations

import ast
import re

import mitsuba as mi
import pytest

import svu_mi.plugins

OTHERWISE = {  # defaults that are no literals, and parameters that Mitsuba or a loop reads
    "filename": "none: required", "shape": "all shapes with UVs", "background": "0",
    "occlusion": "true; false with gaussian and fast", "hide_emitters": "false",
    "max_depth": "none: ignored",
}  # fmt: skip
UNLISTED = {"map", "rr_depth", "texture"}  # in the text or in another row


@pytest.mark.parametrize("name", ["svu_entropy", "svu_sh"])
def test_defaults_are_those_of_the_code(root, name):
    page = (root / "notebooks" / "plugins.md").read_text(encoding="utf-8")
    rows = re.search(rf"## {name}:.*?\n((?:\|[^\n]*\n)+)", page, re.DOTALL)[1]
    listed = dict(re.findall(r"^\| `(\w+)` \| (.*?) \|", rows, re.MULTILINE))
    read = {}
    for node in ast.walk(ast.parse((root / "plugins" / f"{name}.py").read_text())):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("read", "props.get"):
            key, default = node.args[-2:]
            if isinstance(key, ast.Constant) and isinstance(default, ast.Constant):
                read[key.value] = str(default.value).lower().removesuffix(".0")
    assert len(read) >= 2 and set(read) - UNLISTED <= set(listed)
    for parameter, default in listed.items():
        wanted = OTHERWISE.get(parameter, read.get(parameter))
        assert default.replace("`", "") == wanted, parameter


def test_other_defaults_are_those_of_the_plugin(variant):
    kinds = {name: mi.load_dict({"type": "svu_sh", "preset": name})
             for name in ("default", "fixed", "gaussian", "fast")}  # fmt: skip
    assert {name: kind.occlusion for name, kind in kinds.items()} == {
        "default": True, "fixed": True, "gaussian": False, "fast": False,
    }  # fmt: skip
    assert not kinds["default"].hide_emitters
    given = {"type": "svu_entropy", "map": {"type": "checkerboard"}}
    assert list(mi.load_dict(given).background) == [0, 0, 0]
    assert svu_mi.plugins.registry.MODULES == ("svu_entropy", "svu_sh")
