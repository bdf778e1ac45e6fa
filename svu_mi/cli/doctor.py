"""``svu doctor``: installed packages, usable variants, and remedies.

An unusable LLVM or GPU driver can abort a process. Child processes therefore query Dr.Jit and
Mitsuba and render the test picture.
"""

import ctypes
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import distributions
from pathlib import Path

from rich.console import Console

from svu_mi import _llvm
from svu_mi.cli.base_command import VARIANTS, BaseCommand

PACKAGES = ("svu_mi", "mitsuba", "drjit", "OpenEXR", "trimesh", "xatlas", "numpy", "scipy")
TIMEOUT_S = 300  # a first render compiles kernels
CHILD = "import sys; from svu_mi.cli import doctor; doctor.{}(*sys.argv[1:])"
REINSTALL = "reinstall with: pip install --force-reinstall {}"
Facts = dict[str, str]


@dataclass(frozen=True)
class HealthCheck:
    """Result of one check, and the remedy if it failed."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""


@dataclass(frozen=True, kw_only=True)
class Doctor(BaseCommand):
    """Check the installation, and print how to repair it."""

    uses_matplotlib = False

    def run(self, console: Console) -> int:
        """Print facts and checks; return 0 if all checks passed, else 2."""
        with console.status("Checking the installation; the first render compiles kernels"):
            facts, checks = diagnose()
        show(facts, checks, console)
        return 0 if all(check.ok for check in checks) else 2


def diagnose() -> tuple[Facts, list[HealthCheck]]:
    """Return facts by name, and results of checks; takes seconds and raises no exception."""
    versions = {
        name: next((found.version for found in distributions(name=name)), "missing")
        for name in PACKAGES
    }
    loading = _run_child("mitsuba", "collect_facts", remedy=REINSTALL.format("mitsuba drjit"))
    child_facts, llvm = {}, _llvm.status()
    if loading.ok:
        child_facts, loading = json.loads(loading.detail), HealthCheck("mitsuba", True, "loads")
        one = child_facts["llvm"]  # as loaded by Dr.Jit
        llvm = _llvm.LlvmStatus(one["path"], tuple(one["version"]), llvm.source, one["problem"])
    variants = child_facts.get("variants", [])
    usable = [name for name in variants if _can_run(name, child_facts["backends"], llvm)]
    library = f"{_llvm.dotted(llvm.version)}, {llvm.path or 'no file'} ({llvm.source})"
    usual = Path(tempfile.gettempdir()) / "drjit" if sys.platform == "win32" else "~/.drjit"
    facts = {
        "System": f"{platform.system()} {platform.release()} {platform.machine()}",
        "Python": f"{platform.python_version()} ({sys.executable})",
        "Packages": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "Variants": ", ".join(variants) or "unknown",
        "Usable": ", ".join(usable) or "none",
        # Not a failed check, as a GPU may be used instead.
        "LLVM": f"{library}: not usable. {llvm.problem}" if llvm.problem else library,
        **child_facts.get("devices", {}),
        "Threads": str(child_facts.get("threads", 0)),
        "Kernel cache": os.environ.get("DRJIT_CACHE_DIR", str(usual)),
    }
    return facts, [check_packages(versions), loading, *check_renders(usable, llvm), check_exr()]


def _can_run(variant: str, backends: list[str], llvm: _llvm.LlvmStatus) -> bool:
    if variant.startswith("llvm"):
        return llvm.problem is None
    return variant.startswith("scalar") or variant.split("_")[0].upper() in backends


def check_packages(versions: dict[str, str]) -> HealthCheck:
    """Check that no package is missing."""
    missing = ", ".join(name for name, version in versions.items() if version == "missing")
    detail = f"missing: {missing}" if missing else "all installed"
    return HealthCheck("packages", not missing, detail, "pip install svu_mi")


def check_renders(usable: list[str], llvm: _llvm.LlvmStatus) -> list[HealthCheck]:
    """Render with each usable variant of ``VARIANTS``; without any, the check fails."""
    why = llvm.problem or f"this Mitsuba lacks {', '.join(VARIANTS)}"
    checks = [check_render(name) for name in VARIANTS if name in usable]
    return checks or [HealthCheck("render", False, "no variant can run", why)]


def check_render(variant: str) -> HealthCheck:
    """Render a test picture in a child process with one variant."""
    remedy = "update the GPU driver, or use another variant: svu -m llvm_ad_rgb ..."
    if variant.startswith("llvm"):
        remedy = f"unset {_llvm.VARIABLE} if it is set, and {_llvm.remedy()}"
    return _run_child(f"render with {variant}", "render_test", variant, remedy=remedy)


def check_exr() -> HealthCheck:
    """Write an EXR file, including the read-back comparison of ``write_exr``."""
    try:
        import numpy as np

        from svu_mi.core.io.exr import write_exr

        with tempfile.TemporaryDirectory() as folder:
            write_exr(Path(folder) / "doctor.exr", {"Y": np.eye(3, 4, dtype=np.float32)})
    except Exception as error:  # any error is the finding
        return HealthCheck(
            "OpenEXR", False, f"{type(error).__name__}: {error}", REINSTALL.format("OpenEXR")
        )
    return HealthCheck("OpenEXR", True, "a file written and read back is the same")


def _run_child(name: str, function: str, *arguments: str, remedy: str) -> HealthCheck:
    """Run a function of this file in a child process; report its last printed line."""
    command = [sys.executable, "-P", "-c", CHILD.format(function), *arguments]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        return HealthCheck(name, False, f"no answer within {TIMEOUT_S} s", remedy)
    if done.returncode == 0 and done.stdout.strip():
        return HealthCheck(name, True, done.stdout.splitlines()[-1])
    words = done.stderr.strip().rpartition("\n")[2].strip() or "no message"
    if done.returncode < 0:
        number = -done.returncode
        ended = {each.value: each.name for each in signal.Signals}.get(number, f"signal {number}")
        words = f"{ended} terminated the process: {words}"
    return HealthCheck(name, False, words, remedy)


def collect_facts() -> None:
    """Print facts of Dr.Jit and Mitsuba as one line of JSON (in a child process)."""
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
    """Render a white furnace test, whose image is 1, and print its mean (in a child process)."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    from svu_mi.capture.plugin_security import pin_own_plugins

    mi.set_variant(variant)
    pin_own_plugins()
    # LLVM 15 and 16 cannot compile minimum and maximum; 16 bits are the worst case.
    for kind in (mi.Float16, mi.Float, mi.Float64):
        if variant.startswith("metal") and kind is mi.Float64:
            continue  # Metal has no double precision
        value = dr.opaque(kind, 2, 3)
        if not dr.all((dr.minimum(value, 1) == 1) & (dr.maximum(value, 3) == 3)):
            raise RuntimeError("dr.minimum or dr.maximum returns a wrong value")
    white = {"type": "rgb", "value": 1.0}
    # With BSDF samples only, each path has radiance 1: a furnace test without noise.
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


def show(facts: Facts, checks: list[HealthCheck], console: Console) -> None:
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
