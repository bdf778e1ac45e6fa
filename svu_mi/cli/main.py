"""The ``svu`` program: options in, one clear line and exit status 2 on bad input."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Sequence
from typing import Annotated

import tyro
from rich.console import Console

from svu_mi.cli.bench import Bench
from svu_mi.cli.checking import CheckCapture
from svu_mi.cli.commands import Demo, Doctor, Entropy, Render
from svu_mi.cli.exporting import Export
from svu_mi.cli.guide import Guide
from svu_mi.cli.importing import Import
from svu_mi.cli.inputs import was_interrupted
from svu_mi.cli.recover import Recover
from svu_mi.cli.reporting import Report
from svu_mi.cli.viewing import View
from svu_mi.errors import SvuError

Command = (
    Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[CheckCapture, tyro.conf.subcommand("check")]
    | Annotated[Entropy, tyro.conf.subcommand("entropy")]
    | Annotated[Guide, tyro.conf.subcommand("guide")]
    | Annotated[Recover, tyro.conf.subcommand("recover")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: the words after ``svu``; those of this process by default.

    Returns:
        0 on success, 2 on bad input (one line on stderr), 130 when interrupted.
    """
    console = Console()  # stderr is for the one line that says what went wrong
    command = tyro.cli(
        Command,  # type: ignore[arg-type]
        prog="svu",
        description="What photographs say about the reflectance of an object, and how much.",
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.AvoidSubcommands),
    )
    verbose = command.verbose
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, format="svu: %(message)s"
    )
    warnings.showwarning = _show_warning
    try:
        return command.run(console)
    except KeyboardInterrupt as stop:
        return _fail(str(stop) or "interrupted", 130)
    except SvuError as error:
        if verbose:
            raise
        return _fail(str(error), 2)
    except MemoryError:
        return _fail("out of memory; use a smaller --resolution or fewer views", 2)
    except Exception as error:
        if was_interrupted(error):
            return _fail("interrupted", 130)
        if verbose:
            raise
        kind = type(error).__name__
        return _fail(f"internal error ({kind}: {error}); please report it with the output of -v", 1)


def _fail(sentence: str, status: int) -> int:
    # Not through rich: the line must stay one line, whatever the terminal's width.
    sys.stderr.write(f"svu: {' '.join(sentence.split())}\n")
    return status


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    sys.stderr.write(f"svu: warning: {' '.join(str(message).split())}\n")
