"""Register svu_mi's Mitsuba plugins for the active variant.

A plugin class derives from a base of the variant that was active when its module ran, so
each module is reloaded after every variant change. This module itself is never reloaded:
Mitsuba keeps callbacks in a set, and a second function object would run twice.
"""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

from svu_mi.errors import SvuEnvironmentError

MODULES = ("svu_entropy", "svu_sh")  # file name = XML type
_loaded_for: str | None = None


def load(old_variant: str | None = None, new_variant: str | None = None) -> None:
    """Import or reload every plugin module; nothing to do if already done."""
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
    """Refuse variants that a plugin does not run in."""
    if not mi.variant().endswith("_ad_rgb"):
        raise SvuEnvironmentError(
            f"{plugin}: needs a variant such as llvm_ad_rgb, but {mi.variant()} is active."
        )


mi.detail.add_variant_callback(load)
