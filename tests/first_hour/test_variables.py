"""No test of the first hour sets a variable that a user would not set."""

from __future__ import annotations

import ast
import os
from pathlib import Path

from hour import NOT_SET, notebook

HERE = Path(__file__).parent
SETTERS = ("setenv", "putenv", "environ.update", "environ.setdefault", "environ[")


def test_nothing_here_sets_a_variable():
    for path in HERE.glob("*.py"):
        if path == Path(__file__):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            text = ast.unparse(node) if isinstance(node, ast.Call | ast.Assign) else ""
            assert not [word for word in SETTERS if word in text], f"{path.name}: {text}"
            if isinstance(node, ast.Call):  # of the environment of a process, hour.py alone decides
                given = {keyword.arg for keyword in node.keywords}
                assert path.name == "hour.py" or "env" not in given, f"{path.name}: {text}"


def test_processes_have_none_of_those_of_the_tests(tmp_path):
    assert any(name.startswith(NOT_SET) for name in os.environ)  # conftest.py sets one
    said = notebook("import os; print(*os.environ)", tmp_path)
    names = said.out[0].split()
    assert not [name for name in names if name.startswith(NOT_SET)]
    assert set(names) <= {*os.environ, "LC_CTYPE"}
