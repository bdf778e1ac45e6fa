"""``svu doctor``: the installation, what can run, and remedies.

An unusable LLVM or GPU driver can abort a process. Child processes therefore collect the facts of
Dr.Jit and Mitsuba and render the test picture.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console

from svu_mi import _llvm
from svu_mi.cli.common import VARIANTS, Common

PACKAGES = ("svu_mi", "mitsuba", "drjit", "OpenEXR", "trimesh", "xatlas", "numpy", "scipy")
TIMEOUT_S = 300  # a first render compiles kernels
CHILD = "import sys; from svu_mi.cli import doctor; doctor.{}(*sys.argv[1:])"
Facts = dict[str, str]


@dataclass(frozen=True)
class Check:
    """One question, its answer, and the remedy if the answer is bad."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""


@dataclass(frozen=True, kw_only=True)
class Doctor(Common):
    """Say what is installed, what can run here, and what to do about the rest."""

    draws = False

    def run(self, console: Console) -> int:
        """Print facts and checks; return 0 if all checks are passed, else 2."""
        with console.status("Looking around; the first render compiles kernels"):
            facts, checks = diagnose()
        show(facts, checks, console)
        return 0 if all(check.ok for check in checks) else 2


def diagnose() -> tuple[Facts, list[Check]]:
    """Return facts by name, and test results; takes a few seconds, and never raises."""
    versions = {name: _version(name) for name in PACKAGES}
    code, output, errors = _child("collect_facts")
    remedy = "reinstall with: pip install --force-reinstall mitsuba drjit"
    loading = Check("mitsuba", False, _how_it_ended(code, errors), remedy)
    found, llvm = {}, _llvm.status()
    if code == 0 and output.strip():
        found, loading = json.loads(output.splitlines()[-1]), Check("mitsuba", True, "loads")
        one = found["llvm"]  # as Dr.Jit has loaded it; its source is known only here
        llvm = _llvm.LlvmStatus(one["path"], tuple(one["version"]), llvm.source, one["problem"])
    variants = found.get("variants", [])
    usable = [name for name in variants if _runs(name, found["backends"], llvm)]
    library = f"{_llvm.dotted(llvm.version)}, {llvm.path or 'no file'} ({llvm.source})"
    facts = {
        "System": f"{platform.system()} {platform.release()} {platform.machine()}",
        "Python": f"{platform.python_version()} ({sys.executable})",
        "Packages": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "Variants": ", ".join(variants) or "unknown",
        "Usable": ", ".join(usable) or "none",
        # Not a failed check where a GPU does the work.
        "LLVM": f"{library}: not usable. {llvm.problem}" if llvm.problem else library,
        **found.get("devices", {}),
        "Threads": str(found.get("threads", 0)),
        "Kernel cache": _cache_folder(),
    }
    return facts, [check_packages(versions), loading, *check_renders(usable, llvm), check_exr()]


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"


def _runs(variant: str, backends: list[str], llvm: _llvm.LlvmStatus) -> bool:
    if variant.startswith("llvm"):
        return llvm.problem is None
    return variant.startswith("scalar") or variant.split("_")[0].upper() in backends


def _cache_folder() -> str:
    """Return where Dr.Jit keeps compiled kernels, by its own rule."""
    windows = str(Path(tempfile.gettempdir()) / "drjit")
    usual = windows if sys.platform == "win32" else str(Path("~/.drjit").expanduser())
    return os.environ.get("DRJIT_CACHE_DIR", usual)


def check_packages(versions: dict[str, str]) -> Check:
    """Check that no package is missing."""
    missing = [name for name, version in versions.items() if version == "missing"]
    if missing:
        return Check("packages", False, f"missing: {', '.join(missing)}", "pip install svu_mi")
    return Check("packages", True, "all installed")


def check_renders(usable: list[str], llvm: _llvm.LlvmStatus) -> list[Check]:
    """Render with each supported variant that should run; there must be one."""
    variants = [name for name in VARIANTS if name in usable]
    if variants:
        return [check_render(variant) for variant in variants]
    why = llvm.problem or f"this Mitsuba has none of {', '.join(VARIANTS)}"
    return [Check("render", False, "no variant can run", why)]


def check_render(variant: str) -> Check:
    """Render a test picture in a child process with one variant."""
    code, output, errors = _child("render_test", variant)
    name = f"render with {variant}"
    if code == 0 and output.strip():
        return Check(name, True, output.splitlines()[-1])
    remedy = "update the GPU driver, or use another variant: svu -m llvm_ad_rgb ..."
    if variant.startswith("llvm"):
        remedy = f"unset {_llvm.VARIABLE} if it is set, and {_llvm.remedy()}"
    return Check(name, False, _how_it_ended(code, errors), remedy)


def check_exr() -> Check:
    """Write an EXR file to a temporary folder and read it back."""
    remedy = "pip install --force-reinstall OpenEXR"
    try:
        import numpy as np

        from svu_mi.exr import read_exr, write_exr

        plane = np.linspace(0, 2, 12, dtype=np.float32).reshape(3, 4)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "doctor.exr"
            write_exr(path, {"Y": plane})
            same = np.array_equal(read_exr(path)["Y"], plane)
    except Exception as error:  # whatever goes wrong is the finding
        return Check("OpenEXR", False, f"{type(error).__name__}: {error}", remedy)
    if not same:
        return Check("OpenEXR", False, "what was read differs from what was written", remedy)
    return Check("OpenEXR", True, "a file written and read back is the same")


def _child(function: str, *arguments: str) -> tuple[int, str, str]:
    """Run a function of this file in a fresh interpreter: exit code, stdout, stderr."""
    command = [sys.executable, "-P", "-c", CHILD.format(function), *arguments]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        return 1, "", f"no answer within {TIMEOUT_S} s"
    return done.returncode, done.stdout, done.stderr


def _how_it_ended(code: int, errors: str) -> str:
    """Return the last line of a child that failed, and the signal if one ended it."""
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    words = lines[-1] if lines else "no message"
    if code >= 0:
        return words
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"the process was ended by {name}: {words}"


# --- in the child processes ---------------------------------------------------------------


def collect_facts() -> None:
    """Print facts of Dr.Jit and Mitsuba, as one line of JSON."""
    import drjit as dr
    import mitsuba as mi

    kinds = [name for name in ("CUDA", "LLVM", "Metal") if hasattr(dr.JitBackend, name)]
    there = [kind for kind in kinds if dr.has_backend(getattr(dr.JitBackend, kind))]
    backends = [kind.upper() for kind in there]
    with suppress(OSError):
        ctypes.CDLL("nvoptix.dll" if sys.platform == "win32" else "libnvoptix.so.1")
        there.append("OptiX")
    devices = {
        name: "present" if name in there else "absent" for name in ("CUDA", "OptiX", "Metal")
    }
    print(json.dumps({
        "variants": mi.variants(), "backends": backends, "threads": dr.thread_count(),
        "llvm": asdict(_llvm.status()), "devices": devices,
    }))  # fmt: skip


def render_test(variant: str) -> None:
    """Render a white sphere in white light, which shows 1 everywhere, and print its mean."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    from svu_mi.capture.trust import pin_own_plugins

    mi.set_variant(variant)
    pin_own_plugins()
    # Minimum and maximum are what LLVM 15 and 16 cannot compile; 16 bits are the worst case.
    for kind in (mi.Float16, mi.Float, mi.Float64):
        if variant.startswith("metal") and kind is mi.Float64:
            continue  # Metal has no double precision
        value = dr.opaque(kind, 2, 3)
        if not dr.all((dr.minimum(value, 1) == 1) & (dr.maximum(value, 3) == 3)):
            raise RuntimeError("a minimum or maximum is wrong")
    white = {"type": "rgb", "value": 1.0}
    # With BSDF samples only, every path carries exactly 1: the furnace test without noise.
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1},
            "light": {"type": "constant", "radiance": white},
            "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": white}},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16},
            },
        },
        optimize=False,
    )
    image = np.array(mi.render(scene, spp=4))[..., :3]
    if not np.allclose(image, 1, atol=1e-3):
        raise RuntimeError(f"the test picture should be 1, but is {image.min()} to {image.max()}")
    print(f"a test picture has mean {image.mean():.4f} (expected 1)")


# --- printing -----------------------------------------------------------------------------


def show(facts: Facts, checks: list[Check], console: Console) -> None:
    """Print facts, then checks, then remedies."""
    from rich.markup import escape
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    for name, value in facts.items():
        table.add_row(name, escape(value))
    console.print(table)
    console.print()
    for check in checks:
        mark = "[green]ok[/]    " if check.ok else "[red]failed[/]"
        console.print(f"{mark}  {check.name}: {escape(check.detail)}", highlight=False)
    for check in checks:
        if not check.ok:
            console.print(f"Remedy for {check.name}: {escape(check.remedy)}", highlight=False)
