"""Terminals: closed, full, deaf or ASCII only, the work is done; foreign names stay text."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import logging
import os
import pty
import signal
import subprocess
import sys
import warnings

import pytest
from rich.console import Console
from rich.table import Table
from support.helpers import python, write_scene

from svu_mi.cli import main as program
from svu_mi.cli.main import main
from svu_mi.cli.streams import ForgivingStream, LogLines, OneLine, forgiving_streams, print_line
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError, SvuError, SvuWarning, printable

SECONDS = 120
NASTY = "a\nb\r\x1b[31mred\x1b]0;title\x07\u202etxt\u2066.\x9b2J\udcff[/bold][link]"


def svu(redirection: str, *words: object, **environment: str) -> subprocess.CompletedProcess:
    """Run svu in a shell, with some redirection behind it; the status is that of svu."""
    script = f'"$@" {redirection}; exit ${{PIPESTATUS[0]}}'
    return subprocess.run(
        ["bash", "-c", script, "bash", sys.executable, "-m", "svu_mi", *map(str, words)],
        env=os.environ | environment, stdin=subprocess.DEVNULL, capture_output=True,
        timeout=SECONDS,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


def rendering(scene, folder):
    return ("render", scene, "--resolution", 8, 8, "--spp", 1, "-o", folder)


UNREAD = ("| true", ">/dev/full 2>/dev/full", ">&- 2>&- <&-")


@pytest.mark.parametrize(
    "redirection", [UNREAD[0], pytest.param(UNREAD[2], marks=pytest.mark.slow)]
)
def test_work_is_done_with_closed_stdout(scene, tmp_path, redirection):
    done = svu(redirection, *rendering(scene, tmp_path / "out"))
    assert (done.returncode, done.stderr) == (0, b"")
    assert (tmp_path / "out" / "view_0000.exr").stat().st_size > 100
    assert (tmp_path / "out" / "capture.json").stat().st_size > 100


@pytest.mark.few(2)
@pytest.mark.parametrize("redirection", ("| head -n 1", *UNREAD))
def test_help_with_closed_stdout_succeeds(redirection):
    done = svu(redirection, "entropy", "--help")
    assert (done.returncode, done.stderr) == (0, b"")
    assert not done.stdout.count(b"\n") or redirection.startswith("| head")


@pytest.mark.parametrize(
    "redirection", ["2>&-", pytest.param("2>&1 | true", marks=pytest.mark.slow)]
)
def test_mistake_with_closed_stderr_is_status_2(tmp_path, redirection):
    done = svu(redirection, "entropy", tmp_path / "nowhere.xml", "-o", tmp_path / "out")
    assert (done.returncode, done.stdout, done.stderr) == (2, b"", b"")


def test_a_closed_descriptor_gets_no_file_of_ours():
    """Else what C++ prints to descriptor 1 would land in a result."""
    code = (
        "import os; from svu_mi.cli.streams import forgiving_streams\n"
        "with forgiving_streams(): print('x'); assert os.open(os.devnull, os.O_RDONLY) > 2"
    )
    done = subprocess.run(
        ["bash", "-c", '"$@" >&- 2>&- <&-', "bash", sys.executable, "-c", code], timeout=SECONDS
    )
    assert done.returncode == 0


class Broken(io.StringIO):
    def write(self, _text):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")


def closed() -> io.StringIO:
    stream = io.StringIO()
    stream.close()
    return stream


@pytest.mark.parametrize("stream", [Broken, closed])
def test_progress_goes_on_without_its_console(stream):
    progress = Progress(Console(file=stream()))
    with progress.stage("work") as stage:
        stage.update(1, 2)
    assert list(progress.timings) == ["work"]


# --- letters ------------------------------------------------------------------------------

POOR = (
    {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    {"PYTHONIOENCODING": "ascii"},
    {"PYTHONIOENCODING": "cp1252"},
)


@pytest.mark.few(2)
@pytest.mark.parametrize("environment", POOR, ids=lambda e: next(iter(e.values())))
@pytest.mark.parametrize("words", ["entropy --help", "entropy nowhere --speed"])
def test_terminals_without_unicode(environment, words):
    done = svu("", *words.split(), **environment)
    assert b"Error" not in done.stderr.replace(b"Error:", b"")
    assert b"Traceback" not in done.stderr + done.stdout
    assert done.returncode == (0 if "--help" in words else 2)


def test_names_outside_of_ascii_are_escaped(scene, tmp_path):
    folder = tmp_path / "größe_\u4e2d"
    done = svu("", *rendering(scene, folder), PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\u4e2d" in done.stdout and (folder / "view_0000.exr").is_file()


def test_a_live_line_on_a_terminal_without_unicode():
    ours, theirs = pty.openpty()
    code = (
        "import time; from svu_mi.cli.streams import *; from svu_mi.core.progress import *\n"
        "with forgiving_streams():\n"
        "    with Progress(OneLine()).stage('\\xe9'): time.sleep(0.3)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], stdout=theirs, stderr=subprocess.PIPE, timeout=SECONDS,
        env=os.environ | {"PYTHONIOENCODING": "ascii", "TERM": "xterm"},
    )  # fmt: skip
    os.close(theirs)
    shown = os.read(ours, 1 << 16)
    os.close(ours)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\xe9" in shown and b"\\u" not in shown and shown.isascii()


def test_an_ascii_stream_spells_out_what_it_can():
    raw = io.BytesIO()
    stream = ForgivingStream(io.TextIOWrapper(raw, "ascii", write_through=True))
    assert stream.write("±0.05\u202f% \u4e2d") == 9
    assert raw.getvalue() == b"+-0.05 % \\u4e2d"


@pytest.mark.parametrize("utf8", ["0", "1"])
def test_arguments_that_are_not_text_are_refused(tmp_path, utf8):
    words = [b"-m", b"svu_mi", b"entropy", b"x.xml", b"-o", b"out_\xff"]
    done = subprocess.run(
        [sys.executable.encode(), *words], capture_output=True, cwd=tmp_path, timeout=SECONDS,
        env=os.environ | {"PYTHONUTF8": utf8, "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"},
    )  # fmt: skip
    assert done.returncode == 2 and done.stderr.count(b"\n") == 1
    assert done.stderr.startswith(b"svu: out_?: it contains characters that are not valid ")


# --- foreign names in messages --------------------------------------------------------------


def one_line(text: str) -> bool:
    return text.isprintable() and "red" in text and "\u202e" not in text


def test_streams_come_back():
    before = sys.stdout, sys.stderr
    with forgiving_streams():
        assert sys.stdout is not before[0] and sys.stdout.encoding == before[0].encoding
    assert (sys.stdout, sys.stderr) == before


def test_printable_keeps_letters_and_spaces():
    for text in ("", "größe 中文 שלום  two", "12\u202f%", "\u2009"):
        assert printable(text) == text
    assert one_line(printable(NASTY))
    assert printable("a\u2028b\u0085c\td\x00e\ud800") == "a b c d?e?"


def test_messages_warnings_and_log_lines_are_one_line_each(capsys):
    assert program._fail(NASTY, 2) == 2
    program._show_warning(SvuWarning(NASTY))
    record = logging.LogRecord("svu", logging.WARNING, "", 0, "%s", (NASTY,), None)
    LogLines().emit(record)
    lines = capsys.readouterr().err.split("\n")
    assert len(lines) == 4 and all(map(one_line, lines[:3]))
    assert all(line.startswith("svu: ") for line in lines[:3])


def test_the_program_logs_that_way(tmp_path):
    """Under pytest logging is set up already, so that this takes a process."""
    code = (
        "import logging, svu_mi.cli.main as program\n"
        "program.Doctor.run = lambda self, console: logging.warning(chr(27) + '[31mred\\nx') or 0\n"
        "program.main(['doctor'])"
    )
    assert python("-c", code).stderr == "svu: ?[31mred x\n"


@pytest.mark.parametrize("terminal", [True, False])
def test_lines_tables_and_stages_are_printable(terminal):
    stream = io.StringIO()
    console = OneLine(file=stream, width=200, force_terminal=terminal, color_system=None)
    print_line(console, NASTY)
    console.print(NASTY, markup=False)
    table = Table("name", box=None)
    table.add_row(NASTY)
    console.print(table, markup=False)
    if not terminal:  # where cursor movements of our own are among it
        with Progress(console).stage(NASTY):
            pass
    lines = stream.getvalue().split("\n")
    shown = [line for line in lines if "red" in line]
    assert len(shown) == (3 if terminal else 4) and all(map(one_line, shown))
    assert all("[/bold]" in line for line in shown)


# --- what the system refuses ----------------------------------------------------------------

LONG = "x" * 300
COMMANDS = ("entropy", "check", "guide", "recover", "report", "export", "import", "render", "view")
BAD = (
    *(f"{name} BAD" for name in COMMANDS), "entropy SCENE --images BAD", "render SCENE -o BAD",
    "entropy SCENE --shape BAD --resolution 8", "view SCENE --recovered BAD",
    "entropy SCENE -o BAD", "report SCENE -o BAD",
)  # fmt: skip


@pytest.mark.parametrize("bad", [LONG, "/" + "y" * 5000, "a\0b"], ids=["name", "path", "zero"])
@pytest.mark.parametrize("words", BAD)
@pytest.mark.usefixtures("variant")
def test_impossible_names_are_one_sentence(scene, tmp_path, capsys, monkeypatch, words, bad):
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings(action="ignore", category=SvuWarning):
        status = main([{"BAD": bad, "SCENE": str(scene)}.get(w, w) for w in words.split()])
    error = capsys.readouterr().err
    assert status == 2 and error.startswith("svu: ") and error.count("\n") == 1
    assert "internal" not in error and "\0" not in error


REFUSALS = {
    OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out/a\x1b.exr"): (
        "svu: out/a?.exr: No space left on device; make room, or write to another disk.\n"
    ),
    PermissionError(errno.EACCES, os.strerror(errno.EACCES), b"out"): (
        "svu: out: Permission denied.\n"
    ),
    OSError(errno.EIO, os.strerror(errno.EIO)): "svu: Input/output error.\n",
    OSError("truncated file"): "svu: truncated file.\n",
    ValueError("embedded null byte"): (
        "svu: a file name must not contain a zero byte.\n"
    ),
}  # fmt: skip


@pytest.mark.parametrize(("error", "sentence"), REFUSALS.items(), ids=map(repr, REFUSALS))
def test_system_errors_are_one_sentence(monkeypatch, capsys, error, sentence):
    def refuse(*_):
        raise error

    monkeypatch.setattr(program.Doctor, "run", refuse)
    assert main(["doctor"]) == 2
    assert capsys.readouterr().err == sentence
    with contextlib.suppress(AttributeError), pytest.raises(type(error)):
        main(["doctor", "-v"])


def test_an_error_says_the_same_to_both_but_for_the_call():
    assert SvuError("estimate(): the prior is bad.").shell == "the prior is bad."
    both = OptionError("Use trust=True.", shell="Use --trust.")
    assert (str(both), both.shell) == ("Use trust=True.", "Use --trust.")


@pytest.mark.skipif(sys.platform != "linux", reason="needs a small pipe")
@pytest.mark.parametrize("module", ["svu_mi.cli", "tyro", "rich.console"])
def test_interrupt_during_imports_is_one_line(module):
    words = [sys.executable, "-X", "importtime", "-m", "svu_mi", "--help"]
    with subprocess.Popen(
        words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, bufsize=0
    ) as process:
        assert process.stderr is not None
        # The process waits for a reader after a page of lines: it cannot be far ahead.
        fcntl.fcntl(process.stderr, fcntl.F_SETPIPE_SZ, 4096)
        for line in process.stderr:  # one per import, when it ends
            if line.split()[-1] == module.encode():
                process.send_signal(signal.SIGINT)
                break
        rest = [line for line in process.stderr.read().splitlines() if b"import time:" not in line]
    assert (process.returncode, rest) == (130, [b"svu: interrupted"])
