"""The ``svu`` program: parse arguments, run a command, report errors in one line."""

import difflib
import errno
import logging
import os
import re
import sys
import warnings
from collections.abc import Sequence
from typing import Any

from svu_mi import __version__
from svu_mi.cli.base_command import was_interrupted
from svu_mi.cli.batch.batch import Batch
from svu_mi.cli.bench import Bench
from svu_mi.cli.check import CheckCapture
from svu_mi.cli.compare import Compare
from svu_mi.cli.demo import Demo
from svu_mi.cli.doctor import Doctor
from svu_mi.cli.entropy import Entropy
from svu_mi.cli.export import Export
from svu_mi.cli.guide import Guide
from svu_mi.cli.help import OPTION, command_help, flags_of, overview
from svu_mi.cli.import_ import Import
from svu_mi.cli.inpaint import Inpaint
from svu_mi.cli.light import FindLight
from svu_mi.cli.matplotlib_setup import import_matplotlib
from svu_mi.cli.parse_options import parse_options
from svu_mi.cli.recover import Recover
from svu_mi.cli.refine import Refine
from svu_mi.cli.relight import Relight
from svu_mi.cli.render import Render
from svu_mi.cli.report import Report
from svu_mi.cli.scenes import Scenes
from svu_mi.cli.shared_options import repeat_known
from svu_mi.cli.streams import LogLines, OneLine, forgiving_streams
from svu_mi.cli.view import View
from svu_mi.core.memory import require_start
from svu_mi.errors import OptionError, SvuError, excerpt, printable

# Commands in the order of ``svu --help``.
GROUPS: dict[str, dict[str, Any]] = {
    "start": {"demo": Demo, "scenes": Scenes, "doctor": Doctor},
    "capture": {
        "render": Render, "import": Import, "check": CheckCapture, "refine": Refine,
        "light": FindLight,
    },
    "uncertainty": {"entropy": Entropy, "guide": Guide},
    "textures": {"recover": Recover, "inpaint": Inpaint, "relight": Relight},
    "results": {"report": Report, "view": View, "export": Export, "compare": Compare},
    "many captures": {"batch": Batch, "bench": Bench},
}
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}
DESCRIPTION = "Uncertainty of the reflectance of each texel, estimated from photographs."
SIMILAR = 0.75  # ratio of a proposed option to a misspelt one
LONGEST = 200  # characters of a path in a message
ROOM = "make room, or write to another disk"
REMEDIES = {
    errno.ENAMETOOLONG: "give a shorter one", errno.ENOSPC: ROOM, errno.EDQUOT: ROOM,
    errno.EROFS: "write to another disk",
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; works with closed streams.

    Args:
        arguments: Words after ``svu`` (default: ``sys.argv[1:]``).

    Returns:
        0 on success, 2 on bad input (one line on stderr), 130 when interrupted.
    """
    with forgiving_streams():
        return _run(sys.argv[1:] if arguments is None else arguments)


def parse(name: str = "", *words: str) -> Any:
    """Return the command with this name, with options from the words after it.

    Raises ``OptionError`` for an unknown name or option, and for invalid values.
    """
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, 1)
        remedy = f"did you mean {near[0]}?" if near else "svu --help lists the commands."
        raise OptionError(f"{excerpt(name)}: no such command; {remedy}" if name else remedy)
    command, unknown = parse_options(name, COMMANDS[name], repeat_known(words))
    if unknown:
        raise OptionError(_unknown(name, unknown[0]))
    return command


def _unknown(name: str, word: str) -> str:
    """Return a sentence about a word that a command does not take."""
    option = excerpt(word.partition("=")[0])
    if not word.startswith("-"):
        return f"{excerpt(word)}: svu {name} takes no such argument; svu {name} --help lists all."
    known = re.findall(OPTION, " ".join(flags_of(COMMANDS[name])))
    near = difflib.get_close_matches(option, known, 1, SIMILAR)
    remedy = f"did you mean {near[0]}?" if near else f"svu {name} --help lists all."
    return f"{option}: no such option of svu {name}; {remedy}"


def _run(arguments: Sequence[str]) -> int:
    for word in arguments:
        if problem := _name_problem(word):
            return _fail(f"{excerpt(word, LONGEST)}: {problem}.", 2)
    if list(arguments) == ["--version"]:
        print(f"svu {__version__}")
        return 0
    verbose = not {"-v", "--verbose"}.isdisjoint(arguments)
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, handlers=[LogLines()])
    warnings.showwarning = _show_warning
    try:
        if not {"-h", "--help"}.isdisjoint(arguments):
            name = arguments[0]
            known = name in COMMANDS
            print(command_help(name, COMMANDS[name]) if known else overview(GROUPS, DESCRIPTION))
            return 0
        command = parse(*arguments)
        _require_working_folder()
        require_start()
        if command.uses_matplotlib and getattr(command, "pictures", True):
            import_matplotlib()
        return command.run(OneLine())  # stderr is reserved for errors
    except KeyboardInterrupt as stop:
        return _fail(str(stop) or "interrupted", 130)
    except MemoryError:
        return _fail("out of memory; use a smaller --resolution or fewer views", 2)
    except Exception as error:
        if was_interrupted(error):
            return _fail("interrupted", 130)
        if verbose:
            raise
        return _fail(*_sentence(error))


def _name_problem(word: str) -> str | None:
    """Return the reason why a word is not a valid file name; None if it is valid."""
    if "\0" in word:
        return "a file name must not contain a zero byte"
    try:
        word.encode()
    except UnicodeEncodeError:  # Mitsuba and OpenEXR take UTF-8 only
        encoding = sys.getfilesystemencoding()
        remedy = "rename it" if encoding == "utf-8" else "set PYTHONUTF8=1, or rename it"
        return f"it contains characters that are not valid {encoding}; {remedy}"
    return None


def _require_working_folder() -> None:
    """Refuse a working directory that has been removed: Mitsuba would abort the process."""
    try:
        os.getcwd()
    except OSError as error:
        raise OptionError(
            f"The working directory cannot be used ({error.strerror}); change to another one."
        ) from error


def _sentence(error: Exception) -> tuple[str, int]:
    """Return the message of an error, and the exit status."""
    if isinstance(error, SvuError):
        return error.shell, 2
    if isinstance(error, OSError):  # no space, no permission, a name too long, ...
        named = isinstance(error.filename, str | bytes | os.PathLike)
        place = f"{excerpt(os.fsdecode(error.filename), LONGEST)}: " if named else ""
        remedy = f"; {REMEDIES[error.errno]}" if error.errno in REMEDIES else ""
        return f"{place}{error.strerror or error}{remedy}.", 2
    if isinstance(error, ValueError) and "embedded null" in str(error):  # raised by Python
        return "a file name must not contain a zero byte.", 2
    kind = type(error).__name__
    return f"internal error ({kind}: {error}); please report it with the output of -v", 1


def _fail(sentence: str, status: int) -> int:
    # Not printed by rich, which would wrap the line.
    sys.stderr.write(f"svu: {_line(sentence)}\n")
    return status


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    sys.stderr.write(f"svu: warning: {_line(message)}\n")


def _line(text: object) -> str:
    """Return a message as one line, with the path of the working directory instead of ``.``."""
    line = printable(" ".join(str(text).split()))
    return f"{printable(os.getcwd())}{line[1:]}" if line.startswith(".: ") else line
