"""What of a benchmark could not be run: it is told, and the rest goes on."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from svu_mi.bench.text import table
from svu_mi.errors import SvuError, SvuWarning


@dataclass
class Failures:
    """Errors of a run so far.

    Attributes:
        found: a record each, with ``cell`` and ``reason``.
        first: what was raised first.
    """

    found: list[dict[str, str]] = field(default_factory=list)
    first: SvuError | None = None

    @contextmanager
    def leave_out(self, what: str) -> Iterator[None]:
        """Keep an error of the block, warn, and go on after it."""
        try:
            yield
        except SvuError as error:
            self.first = self.first or error
            self.found.append({"cell": what, "reason": str(error)})
            warnings.warn(f"{what} is left out: {error}", SvuWarning, stacklevel=4)

    def raise_unless(self, done: Any) -> None:
        """Raise the first error unless anything could be run."""
        if not done and self.first is not None:
            raise self.first


def left_out(title: str, record: dict[str, Any], head: str = "cell") -> list[str]:
    """Return Markdown about the failures of a record; nothing without any."""
    rows = [[failed["cell"], failed["reason"]] for failed in record["failed"]]
    return [f"## {title}", table((head, "reason"), rows)] if rows else []
