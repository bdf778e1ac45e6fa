"""Exchange the LLVM library that Dr.Jit has loaded, where nothing was made with it.

Dr.Jit looks for the library when it is first imported. Its core can be shut down and started
again, and then looks anew; functions of C++ do it, which Python has no names for. No array may be
alive then. Mitsuba keeps some of its own from the first variant on, its tables of colours, which
it can give up and compute again.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from pathlib import Path
from typing import Any

SHUTDOWN, INIT = "_Z12jit_shutdowni", "_Z8jit_initj"
WHOS, BOUND = "_Z12jit_var_whosv", "_Z21jit_registry_id_boundPKcS0_"
FORGET_COLORS = "_ZN7mitsuba32color_management_static_shutdownEv"
MAKE_COLORS = "_ZN7mitsuba38color_management_static_initializationEbbb"
NOTHING = "No variables registered"  # of jit_var_whos
LLVM = 1 << 2  # a bit of jit_init
DOMAINS = ("BSDF", "Emitter", "Film", "Medium", "PhaseFunction", "Sampler", "Sensor", "Shape",
           "Texture", "Volume")  # fmt: skip


def reload(variable: str, library: str) -> bool:
    """Have Dr.Jit load another LLVM library, where that is safe.

    Args:
        variable: of the environment, where Dr.Jit looks for the library's path.
        library: the path of one that can be loaded.

    Returns:
        Whether it was exchanged. If not, something is alive that the old library has made, a GPU
        is in use, too, or this Dr.Jit is not known here; or, which nobody has seen, Dr.Jit does
        not like the new one and has none from now on.
    """
    try:
        core = _Core()
    except (OSError, AttributeError):  # no such library or function
        return False
    if core.has_others():
        return False
    gc.collect()
    core.forget_colors()
    if not core.is_unused():
        core.make_colors()
        return False
    os.environ[variable] = library
    if not core.restart():  # nor is there anything to compute colours with
        return False
    core.make_colors()
    return True


def is_in_use() -> bool:
    """Return whether an LLVM variant is set, or arrays or objects of one are alive."""
    mitsuba: Any = sys.modules.get("mitsuba")
    if mitsuba is not None and (mitsuba.variant() or "").startswith("llvm"):
        return True
    try:
        core = _Core()
    except (OSError, AttributeError):
        return False
    return not (core.has_others() or core.is_unused())


class _Core:
    """What is called of Dr.Jit and Mitsuba: all of it is there, or nothing is called.

    Raises:
        OSError: a library is not where it should be.
        AttributeError: it lacks a function.
    """

    def __init__(self) -> None:
        core = drjit_core()
        self._shutdown = function(core, SHUTDOWN, None, ctypes.c_int)
        self._init = function(core, INIT, None, ctypes.c_uint)
        self._whos = function(core, WHOS, ctypes.c_char_p)
        self._bound = function(core, BOUND, ctypes.c_uint, ctypes.c_char_p, ctypes.c_char_p)
        # A variant's tables of colours are made when its module is imported.
        self._variants = [name for name in sys.modules if name.startswith("mitsuba.llvm")]
        if self._variants:
            import mitsuba as mi

            library = ctypes.CDLL(str(Path(mi.__file__).with_name("libmitsuba.so")))
            self._forget = function(library, FORGET_COLORS, None)
            self._make = function(library, MAKE_COLORS, None, *[ctypes.c_bool] * 3)

    def has_others(self) -> bool:
        """Return whether Dr.Jit runs on a GPU, too, which a restart would take arrays from."""
        import drjit as dr

        kinds = [getattr(dr.JitBackend, name, None) for name in ("CUDA", "Metal")]
        return any(dr.has_backend(kind) for kind in kinds if kind is not None)

    def is_unused(self) -> bool:
        """Return whether no array is alive, and no object of Mitsuba's is known to Dr.Jit."""
        objects = (
            self._bound(variant.removeprefix("mitsuba.").encode(), domain.encode())
            for variant in self._variants
            for domain in DOMAINS
        )
        return NOTHING in self._whos().decode(errors="replace") and not any(objects)

    def restart(self) -> bool:
        """Let Dr.Jit look for its library again; return whether it has taken one."""
        import drjit as dr

        self._shutdown(0)
        self._init(LLVM)
        return bool(dr.has_backend(dr.JitBackend.LLVM))

    def forget_colors(self) -> None:
        """Give up Mitsuba's tables of colours, which are arrays."""
        if self._variants:
            self._forget()

    def make_colors(self) -> None:
        """Compute them again."""
        if self._variants:
            self._make(False, True, False)  # for CUDA, LLVM, Metal


def drjit_core() -> Any:
    """Load the library that Dr.Jit itself uses.

    Raises:
        OSError: it is not where it should be.
    """
    import drjit as dr

    return ctypes.CDLL(str(Path(dr.__file__).with_name("libdrjit-core.so")))


def function(library: Any, name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of a library, with the types of its result and its arguments.

    Raises:
        AttributeError: there is none of that name.
    """
    found = getattr(library, name)
    found.restype, found.argtypes = result, arguments
    return found
