"""Selection of the LLVM library that Dr.Jit loads.

Dr.Jit 1.5 accepts LLVM 15 and 16, but on x86-64 these abort the whole process at the first
minimum or maximum ("Cannot select ... fminimum"). ``bootstrap`` therefore points
``DRJIT_LIBLLVM_PATH`` at a library of version 17 or later. It searches in this order: the user's
variable, the system, conda, Homebrew, Windows, the karellen-llvm-core wheel.

Dr.Jit loads its library on import. If it was imported first and loaded a library that aborts,
``import svu_mi`` raises an error if an LLVM variant is set. Otherwise ``require`` raises it before
an LLVM variant is used, so CUDA and Metal are not affected.
"""

import ctypes
import os
import platform
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from svu_mi.errors import SvuEnvironmentError

VARIABLE = "DRJIT_LIBLLVM_PATH"
WHEEL = "karellen-llvm-core"
# No file has this name, so Dr.Jit loads nothing and shows it in its own message. The user's value
# follows the colon, for child processes that inherit the variable.
REFUSED = "refused-by-svu_mi:"
FIRST_ACCEPTED = 15  # by Dr.Jit 1.5
FIRST_GOOD_X86 = 17  # older ones cannot lower llvm.minimum and llvm.maximum on x86-64
RUNTIME = ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")  # in loading order
NAME = re.compile(r"libLLVM(?:[-.](\d[\d.]*))?\.(?:so(?:\.(\d[\d.]*))?|dylib)|LLVM-C\.dll")

Version = tuple[int, ...]


@dataclass(frozen=True)
class LlvmStatus:
    """LLVM library that Dr.Jit uses or will use.

    Attributes:
        path: path of the library; None if missing, or if Dr.Jit selected it.
        version: version such as (19, 1, 7); only (19,) or (19, 1) before Dr.Jit is loaded, () if
            unknown.
        source: ``user``, ``system``, ``conda``, ``brew``, ``windows``, ``wheel``, ``drjit``
            (selected by Dr.Jit, which was imported before svu_mi) or ``none``.
        problem: reason why LLVM variants cannot run, with the remedy; None if they can.
    """

    path: str | None
    version: Version
    source: str
    problem: str | None = None


_status: LlvmStatus | None = None


def bootstrap() -> None:
    """Choose a library on ``import svu_mi`` and set the variable of Dr.Jit.

    Raises:
        SvuEnvironmentError: an LLVM variant is set, and its library would abort the process.
    """
    global _status
    if _status is None:
        _status = _early_drjit() if "drjit" in sys.modules else choose()


def status() -> LlvmStatus:
    """Return the chosen library, or the one in use if Dr.Jit is already loaded."""
    bootstrap()
    assert _status is not None
    if "drjit" in sys.modules and _status.problem is None:
        return _judge_loaded(_status)
    return _status


def require() -> None:
    """Raise an error if no LLVM is usable; to be called before the first LLVM kernel.

    Raises:
        SvuEnvironmentError: no usable LLVM; the message contains the remedy for this system.
    """
    problem = status().problem
    if problem is not None:
        raise SvuEnvironmentError(problem)


def remedy() -> str:
    """Return installation instructions for this system, as the end of a sentence."""
    if sys.platform == "darwin":
        return "use the variant metal_ad_rgb, or run 'brew install llvm'."
    if sys.platform == "win32":
        return f"install LLVM and set {VARIABLE} to ...\\LLVM-C.dll (the file, not the folder)."
    wheel = f"run 'pip install {WHEEL}', or " if is_x86() else ""
    return (
        f"{wheel}install LLVM {first_good()} or newer: 'apt install libllvm19' (Debian, Ubuntu), "
        "'dnf install llvm-libs' (Fedora)."
    )


def is_x86() -> bool:
    """Return True if kernels are compiled for x86-64."""
    return platform.machine().lower() in ("x86_64", "amd64")


def first_good() -> int:
    """Return the lowest major version that works on this machine."""
    return FIRST_GOOD_X86 if is_x86() else FIRST_ACCEPTED


# --- choosing, before Dr.Jit is loaded ----------------------------------------------------


def choose(candidates: Iterable[tuple[str, str]] | None = None) -> LlvmStatus:
    """Choose a library and set the variable that Dr.Jit reads, without loading Dr.Jit.

    Args:
        candidates: (source, path) pairs, the preferred first; default: ``find_candidates()``.
    """
    given = _given()
    chosen = judge_given(given) if given else first_usable(candidates or find_candidates())
    if chosen.problem is None:
        assert chosen.path is not None
        make_loadable(chosen.path)
        os.environ[VARIABLE] = chosen.path
    elif chosen.version and chosen.version[0] >= FIRST_ACCEPTED:
        # Dr.Jit would accept this library and abort in the first kernel of a caller that omits
        # require(). Without a library it raises a plain ImportError instead.
        os.environ[VARIABLE] = REFUSED + given
    return chosen


def _given() -> str:
    return os.environ.get(VARIABLE, "").removeprefix(REFUSED)


def judge_given(given: str) -> LlvmStatus:
    """Check the library set by the user; an invalid one is reported, never replaced."""
    version: Version = ()
    if os.path.isdir(given):
        trouble = "is a folder; set it to the library file inside, or unset it."
    elif os.path.dirname(given) and not os.path.isfile(given):
        trouble = "does not exist; set it to the LLVM library file, or unset it."
    else:
        version = version_of(given)
        if version and version[0] >= first_good():
            return LlvmStatus(given, version, "user")
        what = "is not an LLVM library"
        if version:
            what = f"is LLVM {dotted(version)}, {_reason(version)}"
        trouble = f"{what}; set it to LLVM {first_good()} or newer, or unset it."
    return LlvmStatus(given, version, "user", f"{VARIABLE}: {given} {trouble}")


def first_usable(candidates: Iterable[tuple[str, str]]) -> LlvmStatus:
    """Return the first candidate that is new enough, or a status with ``problem``."""
    refused = None
    for source, path in candidates:
        version = version_of(path)
        if version and version[0] >= first_good():
            return LlvmStatus(path, version, source)
        if version and refused is None:
            refused = LlvmStatus(path, version, source)
    if refused is None:
        return LlvmStatus(None, (), "none", f"No LLVM library was found: {remedy()}")
    problem = (
        f"No usable LLVM library was found: {refused.path} is LLVM {dotted(refused.version)}, "
        f"{_reason(refused.version)}; {remedy()}"
    )
    return LlvmStatus(None, refused.version, "none", problem)


def _reason(version: Version) -> str:
    if version[0] < FIRST_ACCEPTED:
        return "too old for this Dr.Jit"
    return "which aborts the process on x86-64"


def dotted(version: Version) -> str:
    """Write (19, 1, 7) as ``19.1.7``, and () as ``unknown``."""
    return ".".join(map(str, version)) or "unknown"


def make_loadable(library: str) -> None:
    """Load the wheel's C++ runtime if its symbolic links are missing.

    The wheel creates them when Python first starts after pip. A read-only installation, or the
    process that ran pip, lacks them. The runtime is loaded privately (the default), so that no
    other extension uses its symbols.
    """
    folder = os.path.join(os.path.dirname(library), "x86_64-unknown-linux-gnu")
    files = [os.path.join(folder, name) for name in RUNTIME]
    if not os.path.isfile(files[-1]) or os.path.exists(files[-1].removesuffix(".0")):
        return
    try:
        ctypes.CDLL(library)
    except OSError:
        with suppress(OSError):  # require() raises if the library still cannot be loaded
            for file in files:
                ctypes.CDLL(file)


# --- checking the library that Dr.Jit has loaded ------------------------------------------


def _early_drjit() -> LlvmStatus:
    """Check the library that Dr.Jit selected, if Dr.Jit was imported before svu_mi.

    Raises:
        SvuEnvironmentError: an LLVM variant is set, and its library would abort the process.
    """
    given = _given()
    found = _judge_loaded(LlvmStatus(given or None, (), "drjit"))
    if found.problem is None or not found.version:
        return found
    better = judge_given(given) if given else first_usable(find_candidates())
    what = ": restart Python (the kernel), and import svu_mi before drjit and mitsuba."
    if better.problem is not None:
        what = f". {better.problem}"
    problem = f"Dr.Jit has loaded LLVM {dotted(found.version)}, {_reason(found.version)}{what}"
    mitsuba: Any = sys.modules.get("mitsuba")
    if mitsuba is not None and (mitsuba.variant() or "").startswith("llvm"):
        raise SvuEnvironmentError(problem)
    return LlvmStatus(found.path, found.version, found.source, problem)


def _judge_loaded(chosen: LlvmStatus) -> LlvmStatus:
    import drjit as dr

    # Available before any kernel is compiled; -1 if nothing was loaded.
    version = tuple(int(part) for part in dr.detail.llvm_version())
    if version[0] >= first_good():
        return LlvmStatus(chosen.path, version, chosen.source)
    if version[0] >= 0:
        which = f"LLVM {dotted(version)}" + (f" ({chosen.path})" if chosen.path else "")
        problem = f"Dr.Jit loaded {which}, {_reason(version)}."
    else:
        version = ()
        problem = f"Dr.Jit could not load an LLVM library{_cause(chosen.path)}."
    if chosen.source != "drjit":
        problem = f"{problem[:-1]}; {remedy()}"
    return LlvmStatus(chosen.path, version, chosen.source, problem)


def _cause(path: str | None) -> str:
    try:
        _ = ctypes.CDLL(path).LLVMGetVersion if path else None
    except (OSError, AttributeError) as error:  # not a library, or not LLVM
        return f" ({error})"
    return ""


# --- searching for libraries --------------------------------------------------------------


def find_candidates() -> Iterator[tuple[str, str]]:
    """Yield (source, path) of library files, the preferred first; later ones are slower to find."""
    conda = os.environ.get("CONDA_PREFIX")
    if sys.platform == "win32":
        if conda:
            yield from newest_first("conda", [os.path.join(conda, "Library", "bin")])
        yield from newest_first("windows", [r"C:\Program Files\LLVM\bin"])
        return
    if sys.platform.startswith("linux"):
        yield from newest_first("system", _linux_folders())
    if conda:
        yield from newest_first("conda", [os.path.join(conda, "lib")])
    if sys.platform == "darwin":
        for root in ("/opt/homebrew/opt", "/usr/local/opt"):
            yield from newest_first("brew", [f"{root}/{name}/lib" for name in _llvms(root)])
    elif is_x86():
        yield from newest_first("wheel", [os.path.join(sys.prefix, "lib")])
        yield from newest_first("wheel", _wheel_folders())


def _linux_folders() -> list[str]:
    folders = [path for path in os.environ.get("LD_LIBRARY_PATH", "").split(":") if path]
    for root in ("/usr/lib", "/usr/lib64", "/usr/local/lib"):
        folders += [root, *(f"{root}/{name}/lib" for name in _llvms(root))]
    return [*folders, f"/usr/lib/{os.uname().machine}-linux-gnu"]


def _llvms(root: str) -> list[str]:
    """Return folders of LLVM packages: llvm-19 (Debian), llvm19 (Fedora), llvm@19 (Homebrew)."""
    return [name for name in _listed(root) if re.fullmatch(r"llvm[-@]?\d*", name)]


def _listed(folder: str) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:
        return []


def newest_first(source: str, folders: Iterable[str]) -> list[tuple[str, str]]:
    """Return (source, path) of library files, newest first; unknown versions come last."""
    found = {
        os.path.realpath(os.path.join(folder, name))
        for folder in folders
        for name in _listed(folder)
        if NAME.fullmatch(name)
    }
    ordered = sorted(found, key=lambda path: (stated_version(path), path), reverse=True)
    return [(source, path) for path in ordered if os.path.isfile(path)]


def _wheel_folders() -> list[str]:
    """Return folders of the wheel outside ``sys.prefix``, as with ``pip install --user``."""
    import importlib.metadata  # takes 25 ms, and is rarely needed

    with suppress(importlib.metadata.PackageNotFoundError):
        files = importlib.metadata.files(WHEEL) or []
        return [os.path.dirname(file.locate()) for file in files if NAME.search(file.name)]
    return []


# --- versions -----------------------------------------------------------------------------


def stated_version(path: str) -> Version:
    """Return the version in a resolved path, () if missing.

    ``libLLVM-15.so.1`` is 15, ``libLLVM.so.19.1`` is 19.1, and so is
    ``Cellar/llvm/19.1/lib/libLLVM.dylib``.
    """
    match = NAME.fullmatch(os.path.basename(path))
    text = (match.group(1) or match.group(2)) if match else None
    if text is None:
        cellar = re.search(r"/Cellar/llvm(?:@\d+)?/(\d[\d.]*)", path)
        text = cellar.group(1) if cellar else ""
    return tuple(int(part) for part in text.split(".") if part)


def version_of(path: str) -> Version:
    """Return the version of a library, () if it cannot be loaded or is older than 16.

    A version in the file name is used unchecked: loading the library (100 MB) would take longer
    than the whole import, and ``status`` checks it later. Otherwise a subprocess loads the
    library, so that neither a crash nor its symbols reach this process.
    """
    return stated_version(os.path.realpath(path)) or _queried_version(path)


def _queried_version(path: str) -> Version:
    import subprocess  # takes 6 ms, and is rarely needed

    script = (
        "import ctypes, sys\n"
        "version = [ctypes.c_uint() for _ in range(3)]\n"
        "ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*map(ctypes.byref, version))\n"
        "print(*(part.value for part in version))"
    )
    try:
        result = subprocess.run(
            [sys.executable, "-I", "-S", "-c", script, path],
            capture_output=True, text=True, timeout=20, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return ()
    return tuple(int(part) for part in result.stdout.split())
