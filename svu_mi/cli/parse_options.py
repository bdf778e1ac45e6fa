"""Options of a command from its words; errors are sentences."""

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Any

import tyro

from svu_mi.cli.help import OPTION, REGISTRY, flags_of
from svu_mi.errors import OptionError


def parse_options(name: str, command: Any, words: Sequence[str]) -> tuple[Any, list[str]]:
    """Return a command with options from words, and unknown words; raise for invalid values."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(printed):
            return tyro.cli(  # type: ignore[return-value]
                command, prog=f"svu {name}", args=words, registry=REGISTRY,
                config=(tyro.conf.OmitArgPrefixes, tyro.conf.AvoidSubcommands),
                return_unknown_args=True,
            )  # fmt: skip
    except SystemExit:
        raise OptionError(_refusal(name, flags_of(command), printed.getvalue())) from None


def _refusal(name: str, flags: Sequence[str], printed: str) -> str:
    """Return a sentence about the option that tyro's error message, ``printed``, names first."""
    found = re.search(OPTION, printed)
    option = found[0] if found else ""
    named = [each for each in flags if option in re.findall(OPTION, each)]
    problem = " ".join([f"svu {name} needs", *(f for f in flags if f[0] != "-"), *named])
    if named and "Missing from" not in printed:
        problem = f"{option} takes{named[0].split(option)[1]}"
    return f"{problem}; svu {name} --help explains it."
