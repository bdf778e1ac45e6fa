"""The page of promises: every sentence has its test."""

from __future__ import annotations

import ast
import re

EXEMPT = "Not promised: "


def test_every_promise_names_tests_that_exist(root):
    known = {
        node.name
        for path in (root / "tests").rglob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
    }
    text = (root / "notebooks" / "promises.md").read_text()
    promises = [" ".join(part.split()) for part in re.split(r"^\* ", text, flags=re.MULTILINE)[1:]]
    assert len(promises) > 35
    for promise in promises:
        named = re.findall(r"`(test_\w+)`", promise)
        assert named or promise.startswith(EXEMPT), promise
        assert set(named) <= known, set(named) - known
