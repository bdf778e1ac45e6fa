"""Which photograph to take next: expected entropy of views (Sec. 5.1, Eq. 13).

Names are loaded on first use: the table of strategies is read before Mitsuba is there.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from svu_mi.guidance.strategies import STRATEGIES as STRATEGIES

if TYPE_CHECKING:
    from svu_mi.guidance.candidates import Candidates as Candidates
    from svu_mi.guidance.next_view import next_best_view as next_best_view
    from svu_mi.guidance.options import GuidanceOptions as GuidanceOptions
    from svu_mi.guidance.result import Guidance as Guidance
    from svu_mi.guidance.result import Proposal as Proposal

_HOME = {
    "Candidates": "candidates", "next_best_view": "next_view", "GuidanceOptions": "options",
    "Guidance": "result", "Proposal": "result",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
