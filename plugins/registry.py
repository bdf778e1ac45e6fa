"""Registration of the Mitsuba plugins for the active variant.

Base classes of plugins belong to a variant, so plugin modules are reloaded after each change of the
variant. This module is never reloaded: Mitsuba stores callbacks in a set, and would call both the
old and the new function.
"""

from __future__ import annotations

import importlib
import sys
from typing import Any

import mitsuba as mi

from svu_mi.core.checked_arguments import mismatch
from svu_mi.errors import OptionError, SvuEnvironmentError

MODULES = ("svu_entropy", "svu_sh")  # file name = XML type
_loaded_for: str | None = None


def load(old_variant: str | None = None, new_variant: str | None = None) -> None:
    """Import or reload all plugin modules if the variant has changed."""
    del old_variant, new_variant
    global _loaded_for
    variant = mi.variant()
    if variant is None or variant == _loaded_for or variant.startswith("scalar"):
        return
    for name in MODULES:
        full_name = f"{__package__}.{name}"
        if full_name in sys.modules:
            importlib.reload(sys.modules[full_name])
        else:
            importlib.import_module(full_name)
    _loaded_for = variant


def require_variant(plugin: str) -> None:
    """Raise an error if the active variant is not an ``*_ad_rgb`` one."""
    if not mi.variant().endswith("_ad_rgb"):
        raise SvuEnvironmentError(
            f"{plugin}: needs a variant such as llvm_ad_rgb, but {mi.variant()} is active; call "
            "mi.set_variant('llvm_ad_rgb') first."
        )


def read(props: mi.Properties, name: str, default: Any) -> Any:
    """Return a property of a plugin; raise an error if its type is not that of ``default``."""
    value = props.get(name, default)
    if problem := mismatch(value, type(default)):
        raise OptionError(f"{props.plugin_name()}: {name}{problem}")
    return value


mi.detail.add_variant_callback(load)
