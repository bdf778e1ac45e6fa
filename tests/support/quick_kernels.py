"""Kernels that LLVM hardly optimises: compiled in a third of the time, a third slower when run.

python -m support.quick_kernels MODULE [WORDS ...]  # as python -m MODULE, with such kernels and
                                                    # without repeated work
"""

from __future__ import annotations

import ctypes
import os
import runpy
import sys
from pathlib import Path

from support import idle_threads, repeated_work
from svu_mi import _llvm  # comes before Dr.Jit

OPTIONS = (  # of LLVM's code generator; a version that lacks one of them ignores all
    "-opt-bisect-limit=0", "-opt-bisect-verbose=0", "-optimize-regalloc=0", "-regalloc=fast",
)  # fmt: skip
CACHE = "DRJIT_CACHE_DIR"


def use() -> None:
    """Let this process compile kernels so, and keep them apart from those of child processes.

    Those compile as they do for users; kept in one folder, the faster of two processes would decide
    how a kernel rounds.
    """
    shared = os.environ[CACHE]
    own = Path(shared) / "quick"
    own.mkdir(parents=True, exist_ok=True)
    os.environ[CACHE] = str(own)
    import drjit  # noqa: F401  # reads the variable, and loads LLVM

    os.environ[CACHE] = shared
    idle_threads.sleep_soon()
    path = _llvm.status().path
    if path is not None:
        words = [b"svu_mi", *(option.encode() for option in OPTIONS)]
        array = (ctypes.c_char_p * len(words))(*words)
        ctypes.CDLL(path).LLVMParseCommandLineOptions(len(words), array, b"")


if __name__ == "__main__":
    use()
    repeated_work.remember()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
