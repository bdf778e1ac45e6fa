"""No test of the first hour sets a variable that a user would not set."""

from __future__ import annotations

import os

from support.journey import NOT_SET, SHARED, notebook


def test_processes_have_none_of_those_of_the_tests(tmp_path):
    assert any(name.startswith(NOT_SET) for name in os.environ)  # conftest.py sets one
    said = notebook("import os; print(*os.environ)", tmp_path)
    names = [name for name in said.out[0].split() if name != SHARED]
    assert not [name for name in names if name.startswith(NOT_SET)]
    assert set(names) <= {*os.environ, "LC_CTYPE"}
