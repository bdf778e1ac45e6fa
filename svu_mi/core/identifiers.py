"""Sanitise names for JSON, Markdown, OBJ, Mitsuba XML and MaterialX.

Ids of shapes and sensors can contain line breaks, quotes and unpaired surrogates.
"""

import os
import re

from svu_mi.errors import excerpt

NAMELESS = "object"
LONGEST = 240  # bytes of a file name; file systems take 255, and .NAME.svu-draft has 11 more


def fits_file_name(name: str) -> bool:
    """Return whether a name is short enough for a file and its temporary neighbours."""
    try:
        return len(os.fsencode(name)) <= LONGEST
    except UnicodeEncodeError:  # unpaired surrogates, which JSON allows
        return False


def plain_name(name: str) -> str:
    """Return a non-empty printable line for JSON, glTF, HTML pages and pictures."""
    return excerpt(name) or NAMELESS


def markdown_text(text: str) -> str:
    """Escape a text of unknown origin for Markdown (MDX), which runs braces and tags as code.

    All characters but letters, digits, spaces, dots and hyphens become character references.
    """
    return re.sub(r"[^\w .-]|_", lambda match: f"&#{ord(match[0])};", plain_name(text))


def obj_name(name: str) -> str:
    """Return a name of one word for OBJ and MTL files, without ``#`` and slashes."""
    return re.sub(r"[^\w-]", "_", name) or NAMELESS


def xml_id(name: str) -> str:
    """Return an id for a Mitsuba scene, without characters that XML 1.0 forbids.

    Mitsuba reserves leading underscores, dots and ``$``.
    """
    return re.sub(r"[^\w-]", "_", name).lstrip("_") or "node"


def materialx_name(name: str) -> str:
    """Return a MaterialX name: ASCII letters, underscores and digits; no digit at the start."""
    word = re.sub(r"\W", "_", name, flags=re.ASCII) or NAMELESS
    return f"_{word}" if word[0].isdigit() else word
