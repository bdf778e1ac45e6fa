"""Choose the LLVM library before Dr.Jit loads one by itself.

Dr.Jit 1.5 accepts LLVM 15 and 16, but on x86-64 these abort the whole process at the first
minimum or maximum ("Cannot select ... fminimum"). ``bootstrap`` therefore points
``DRJIT_LIBLLVM_PATH`` at a library of version 17 or later, looked for in this order: the
user's own variable, the system, conda, Homebrew, Windows, the karellen-llvm-core wheel. It
never raises, so that CUDA and Metal users are not bothered; ``require`` does, when an LLVM
variant is about to be used.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from svu_mi.errors import SvuEnvironmentError

VARIABLE = "DRJIT_LIBLLVM_PATH"
WHEEL = "karellen-llvm-core"
FIRST_GOOD, FIRST_ACCEPTED = 17, 15
PRELOAD = ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")


@dataclass(frozen=True)
class LlvmStatus:
    """What the bootstrap found.

    Attributes:
        path: the library chosen, None if there is none.
        version: its major version, 0 if unknown.
        source: where it comes from: ``user``, ``system``, ``conda``, ``brew``, ``windows``,
            ``wheel`` or ``drjit`` (loaded before svu_mi was imported).
        problem: why LLVM variants cannot run, with the remedy; None if they can.
    """

    path: str | None
    version: int
    source: str
    problem: str | None = None


@dataclass(frozen=True)
class Candidate:
    """A library file that might do."""

    path: Path
    source: str


_status: LlvmStatus | None = None


def bootstrap() -> None:
    """Choose a library and tell Dr.Jit; runs once, on ``import svu_mi``."""
    global _status
    if _status is None:
        _status = _loaded() if "drjit" in sys.modules else choose()


def status() -> LlvmStatus:
    """Return what was chosen; after Dr.Jit is loaded, what it really uses."""
    bootstrap()
    assert _status is not None
    if "drjit" in sys.modules and _status.problem is None:
        loaded = _loaded()
        if loaded.problem is not None:
            return loaded
    return _status


def require() -> None:
    """Refuse to go on without a usable LLVM; call before the first LLVM kernel.

    Raises:
        SvuEnvironmentError: with the remedy for this operating system.
    """
    problem = status().problem
    if problem is not None:
        raise SvuEnvironmentError(problem)


def choose() -> LlvmStatus:
    """Choose a library and set the variable that Dr.Jit reads (without loading Dr.Jit)."""
    given = os.environ.get(VARIABLE)
    if given:
        return _judge_given(Path(given))
    for candidate in candidates():
        version = library_version(candidate.path)
        if version >= FIRST_GOOD or (version >= FIRST_ACCEPTED and not _is_x86()):
            if candidate.source == "wheel":
                _make_loadable(candidate.path)
            os.environ[VARIABLE] = str(candidate.path)
            return LlvmStatus(str(candidate.path), version, candidate.source)
    problem = f"No usable LLVM library (version {FIRST_GOOD} or later) was found: {remedy()}"
    return LlvmStatus(None, 0, "none", problem)


def _judge_given(path: Path) -> LlvmStatus:
    """Check the user's own choice; it is never overruled."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "no such file"
        problem = f"{VARIABLE} is {path}, {what}; set it to the libLLVM file itself, or unset it."
        return LlvmStatus(str(path), 0, "user", problem)
    version = library_version(path)
    if version == 0:
        problem = (
            f"{VARIABLE} is {path}, which cannot be loaded as an LLVM library of version "
            f"{FIRST_GOOD} or later; unset it, or {remedy()}"
        )
        return LlvmStatus(str(path), 0, "user", problem)
    if version < FIRST_ACCEPTED or (version < FIRST_GOOD and _is_x86()):
        return LlvmStatus(str(path), version, "user", _too_old(version, str(path)))
    return LlvmStatus(str(path), version, "user")


def _loaded() -> LlvmStatus:
    """Read the version of the library that Dr.Jit has already loaded."""
    import drjit as dr

    version = int(dr.detail.llvm_version()[0])
    path = os.environ.get(VARIABLE)
    if version < 0:
        problem = f"Dr.Jit found no LLVM library: {remedy()}"
        return LlvmStatus(path, 0, "drjit", problem)
    if version < FIRST_GOOD and _is_x86():
        return LlvmStatus(path, version, "drjit", _too_old(version, path or "chosen by Dr.Jit"))
    return LlvmStatus(path, version, "drjit")


def _too_old(version: int, where: str) -> str:
    return (
        f"LLVM {version} ({where}) would abort the process with this Dr.Jit on x86-64; "
        f"{remedy()} Import svu_mi before drjit and mitsuba to let it choose."
    )


def remedy() -> str:
    """Return what to do on this operating system, as one sentence."""
    if sys.platform == "darwin":
        return "use the variant metal_ad_rgb, or 'brew install llvm'."
    if sys.platform == "win32":
        return f"install LLVM and set {VARIABLE} to its LLVM-C.dll (the file, not the folder)."
    if platform.machine() == "x86_64":
        return f"'pip install {WHEEL}', or install your distribution's libllvm19 (or newer)."
    return "install your distribution's libllvm19 (or newer)."


def _is_x86() -> bool:
    return platform.machine().lower() in ("x86_64", "amd64")


# --- where libraries are ------------------------------------------------------------------


def candidates() -> Iterator[Candidate]:
    """Yield library files, the preferred first."""
    if sys.platform.startswith("linux"):
        folders = ("/usr/lib", "/usr/lib64", f"/usr/lib/{platform.machine()}-linux-gnu")
        yield from _newest_first(folders, "libLLVM*.so*", "system")
        conda = os.environ.get("CONDA_PREFIX")
        if conda:
            yield from _newest_first((f"{conda}/lib",), "libLLVM*.so*", "conda")
        yield from _wheel()
    elif sys.platform == "darwin":
        for root in ("/opt/homebrew/opt", "/usr/local/opt"):
            folders = tuple(str(folder) for folder in Path(root).glob("llvm*/lib"))
            yield from _newest_first(folders, "libLLVM*.dylib", "brew")
    elif sys.platform == "win32":
        path = Path(r"C:\Program Files\LLVM\bin\LLVM-C.dll")
        if path.is_file():
            yield Candidate(path, "windows")


def _newest_first(folders: tuple[str, ...], pattern: str, source: str) -> Iterator[Candidate]:
    files = (path for folder in folders for path in Path(folder).glob(pattern))
    found = {path.resolve(): path for path in files}
    # A name without a version can hide any version, and comes last.
    for path in sorted(found.values(), key=lambda p: -(version_in_name(p.name) or 0)):
        yield Candidate(path, source)


def _wheel() -> Iterator[Candidate]:
    """Find the wheel's library: in the prefix (fast), else where its metadata says."""
    named = sorted((Path(sys.prefix) / "lib").glob("libLLVM.so.*"))
    named = named or sorted(_wheel_files())
    for path in named:
        if path.is_file() and version_in_name(path.name):
            yield Candidate(path.resolve(), "wheel")
            return


def _wheel_files() -> list[Path]:
    import importlib.metadata  # takes 20 ms, and is rarely needed

    try:
        files = importlib.metadata.files(WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return [Path(str(f.locate())) for f in files if f.name.startswith("libLLVM.so.")]


def version_in_name(name: str) -> int | None:
    """Return the major version a file name states: libLLVM-15.so, libLLVM.so.19.1."""
    match = re.search(r"libLLVM-?(\d+)", name) or re.search(r"libLLVM\.(?:so|dylib)\.(\d+)", name)
    return int(match.group(1)) if match else None


def library_version(path: Path) -> int:
    """Return the major LLVM version of a file, 0 if it is unknown or below 16.

    A name that states a version is believed: a subprocess would cost more than the whole
    import. Otherwise a subprocess asks the library, so that a broken one cannot hurt.
    """
    stated = version_in_name(path.resolve().name) or version_in_name(path.name)
    if stated:
        return stated
    import subprocess  # not needed where names tell

    script = (
        "import ctypes,sys\n"
        "library=ctypes.CDLL(sys.argv[1])\n"
        "v=[ctypes.c_uint() for _ in range(3)]\n"
        "library.LLVMGetVersion(*map(ctypes.byref,v))\n"
        "print(v[0].value)"
    )
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-c", script, str(path)],
            capture_output=True, text=True, timeout=20, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return 0
    return int(done.stdout) if done.returncode == 0 and done.stdout.strip().isdigit() else 0


def _make_loadable(library: Path) -> None:
    """Load the wheel's C++ runtime by hand while its symlinks are not made yet.

    The wheel makes them the first time its interpreter starts after pip; a read-only
    installation, or the very process that ran pip, never sees them.
    """
    folders = (library.parent, library.parent / "x86_64-unknown-linux-gnu")
    if any((folder / "libc++.so.1").exists() for folder in folders):
        return
    try:
        ctypes.CDLL(str(library))
    except OSError:
        for path in (folder / name for name in PRELOAD for folder in folders):
            if path.is_file():
                ctypes.CDLL(str(path))
