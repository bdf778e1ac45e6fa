"""The page on troubleshooting quotes what the program says, and links to what exists."""

from __future__ import annotations

import ast
import re

import pytest

GAP = "..."
SHORTEST = 4  # letters of a piece between gaps that is worth looking for


@pytest.fixture(scope="module")
def page(root):
    return (root / "notebooks" / "troubleshooting.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def sources(root):
    return [strings(path.read_text(encoding="utf-8")) for path in (root / "svu_mi").rglob("*.py")]


def strings(source: str) -> str:
    """All strings of a module but docstrings, one per line; a gap where an f-string has a value."""
    tree = ast.parse(source)
    words, inner = [], set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr):  # docstrings
            inner.update(id(child) for child in ast.walk(node) if isinstance(child, ast.Constant))
        if isinstance(node, ast.JoinedStr):
            inner.update(id(part) for part in node.values)
            parts = (p.value if isinstance(p, ast.Constant) else GAP for p in node.values)
            words.append("".join(str(part) for part in parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            words.append("" if id(node) in inner else node.value)
    return "\n".join(words)


def quoted(page: str) -> list[str]:
    return [line.removeprefix("> ") for line in page.splitlines() if line.startswith("> ")]


def is_said(message: str, sources: list[str]) -> bool:
    """Whether all pieces of a message between its gaps stand in one module."""
    pieces = [piece.strip(" :;,'()") for piece in message.split(GAP)]
    pieces = [piece for piece in pieces if len(piece) >= SHORTEST]
    assert pieces, message
    return any(all(piece in text for piece in pieces) for text in sources)


def test_every_message_is_said_somewhere(page, sources):
    assert len(quoted(page)) > 30
    missing = [message for message in quoted(page) if not is_said(message, sources)]
    assert not missing, "\n".join(missing)


def test_links_lead_somewhere(page, root):
    headings = {
        re.sub(r"[^\w -]", "", line.lstrip("# ")).lower().replace(" ", "-")
        for line in page.splitlines() if line.startswith("#")
    }  # fmt: skip
    for target in re.findall(r"\]\(([^)]+)\)", page):
        if target.startswith("#"):
            assert target[1:] in headings, target
        else:
            assert (root / "notebooks" / target).is_file(), target


def test_fixes_and_options_exist(page, root):
    from svu_mi.formats.fixes import FIXES

    kinds = "|".join(sorted({name.split("-")[0] for name in FIXES}))
    named = set(re.findall(rf"`((?:{kinds})-[a-z0-9-]+)`", page))
    assert named
    assert named <= set(FIXES)
