"""Sanitise names for JSON, OBJ, Mitsuba XML and MaterialX.

A shape's id or a sensor's may be any text: with line breaks, quotes, or half a surrogate pair.
"""

from __future__ import annotations

import re

from svu_mi.errors import excerpt

NAMELESS = "object"


def plain_name(name: str) -> str:
    """Return a name that is one printable line, not empty: for JSON, glTF, pages and pictures."""
    return excerpt(name) or NAMELESS


def obj_name(name: str) -> str:
    """Return a name for a statement of OBJ or MTL: one word, no comment, and no path."""
    return re.sub(r"[^\w-]", "_", name) or NAMELESS


def xml_id(name: str) -> str:
    """Return an id for a Mitsuba scene, which keeps leading underscores, dots and ``$`` for itself.

    What XML 1.0 cannot hold is not a letter, so it goes, too.
    """
    return re.sub(r"[^\w-]", "_", name).lstrip("_") or "node"


def materialx_name(name: str) -> str:
    """Return a name for MaterialX: ASCII letters, digits and underscores, a digit not first."""
    word = re.sub(r"\W", "_", name, flags=re.ASCII) or NAMELESS
    return f"_{word}" if word[0].isdigit() else word
