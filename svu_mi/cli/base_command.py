"""Base classes of commands: variant, threads, output folder, and Ctrl-C."""

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from rich.console import Console
from tyro.conf import arg

from svu_mi import _llvm
from svu_mi.cli.shared_options import Output, Overwrite, as_dict, require_range
from svu_mi.cli.streams import print_line
from svu_mi.core.io.output_folder import Claim, claimed
from svu_mi.core.progress import Progress
from svu_mi.errors import SvuEnvironmentError, excerpt

if TYPE_CHECKING:
    from svu_mi.output.run_record import RunInfo

log = logging.getLogger(__name__)

VARIANTS = ("cuda_ad_rgb", "metal_ad_rgb", "llvm_ad_rgb")  # the first that this machine can run

MAX_THREADS = 1024

Threads = Annotated[
    int,
    arg(
        aliases=["-t"], metavar="N",
        help="CPU threads, at least 2, which Mitsuba needs to read EXR; 0: all cores.",
    ),
]  # fmt: skip
Verbose = Annotated[bool, arg(aliases=["-v"], help="Print log messages and tracebacks of errors.")]
Variant = Annotated[
    str,
    arg(
        aliases=["-m"], metavar="NAME",
        help="Mitsuba variant; auto: cuda_ad_rgb, metal_ad_rgb or llvm_ad_rgb, if available.",
    ),
]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class BaseCommand:
    """Base class of commands; ``-m``, ``-t`` and ``-v`` are as in the program mitsuba."""

    uses_matplotlib: ClassVar[bool] = True
    """True if the command imports matplotlib for pictures."""
    first: ClassVar[str] = ""
    """Names of the options that ``--help`` shows first, in order."""
    variant: Variant = "auto"
    threads: Threads = 0
    verbose: Verbose = False
    trust: bool = False
    """Load Mitsuba plugins from a folder named plugins next to the scene or in the working
    directory. They run with your rights; refused by default."""

    def start(self) -> None:
        """Set the variant and the number of threads."""
        require_range("--threads", self.threads, 0, MAX_THREADS)
        import mitsuba as mi

        from svu_mi.core.threads import FEWEST_THREADS, ensure_threads

        self._set_variant()
        import svu_mi.plugins  # noqa: F401 - registers them for the variant
        from svu_mi.capture.plugin_security import require_own_plugins

        require_own_plugins(self.trust)
        if self.threads == 1:
            log.warning(f"--threads 1: using {FEWEST_THREADS}, which Mitsuba needs to read EXR.")
        ensure_threads(self.threads)
        mi.set_log_level(mi.LogLevel.Info if self.verbose else mi.LogLevel.Error)

    def run_info(self, progress: Progress) -> "RunInfo":
        """Return the options and kernels of this run, for ``run.json``."""
        from svu_mi.output.run_record import RunInfo

        return RunInfo(settings=as_dict(self), kernels=progress.kernels)

    def _set_variant(self) -> None:
        import drjit as dr
        import mitsuba as mi

        name, known = self.variant, mi.variants()
        if name not in ("auto", *known):
            usable = [each for each in VARIANTS if each in known]
            raise SvuEnvironmentError(
                f"This Mitsuba has no variant '{name}'; omit -m, or use {' or '.join(usable)}."
            )
        if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
            raise SvuEnvironmentError(
                f"Variant {name} needs a GPU, and Dr.Jit found none; omit -m, or run svu doctor."
            )
        try:
            mi.set_variant(*(VARIANTS if name == "auto" else (name,)))
        except (ImportError, AttributeError, ValueError, RuntimeError) as error:
            _llvm.require()  # the likely cause, with its remedy
            raise SvuEnvironmentError(
                f"Variant '{name}' is not available: {excerpt(error)}; run svu doctor."
            ) from error


@dataclass(frozen=True, kw_only=True)
class ResultCommand(BaseCommand):
    """Base class of commands that write a folder."""

    command: ClassVar[str]
    """Name in the record of the result."""
    keep: ClassVar[str] = ""
    """Pattern of files that are kept if a run fails."""
    page: ClassVar[str] = ""
    """Main page of the result, if it has one."""
    output: Output = Path("out")
    overwrite: Overwrite = False

    def run(self, console: Console) -> int:
        """Check the options, claim the output folder, run ``work``, and print its lines."""
        self.check()
        with claimed(self.output, self.command, overwrite=self.overwrite, keep=self.keep) as place:
            self.start()
            lines = self.work(Progress(console), place)
        print_line(console, f"Wrote {self.output / self.page}")
        for line in lines:
            print_line(console, line)
        return 0

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""

    def work(self, progress: Progress, place: Claim) -> Iterable[str]:
        """Write the result; return lines to print."""
        raise NotImplementedError


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, with instructions on how to continue."""


@contextmanager
def interruptible(advice: Callable[[], str]) -> Iterator[None]:
    """Raise ``Interrupted`` with instructions if Ctrl-C ends the block."""
    try:
        yield
    except BaseException as error:
        if was_interrupted(error):
            raise Interrupted(advice()) from None
        raise


def was_interrupted(error: BaseException | None) -> bool:
    """Return whether Ctrl-C caused an error, which Dr.Jit may have wrapped in another one."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False
