"""Uncertainty for SVBRDF acquisition using frequency analysis, on Mitsuba 3 and Dr.Jit.

``import svu_mi as svu`` is light: it finds a usable LLVM library (``svu_mi._llvm``) and, except on
one core (``svu_mi.core.limits``), imports nothing else. Every public name below is loaded on first
use; no Mitsuba variant is ever set on import.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from svu_mi import _llvm
from svu_mi.core import limits

if TYPE_CHECKING:
    from svu_mi.calibration.checks.check import check
    from svu_mi.calibration.checks.check_result import Check
    from svu_mi.calibration.exposure import equalized, estimate_gains
    from svu_mi.calibration.light.estimate_light import estimate_light
    from svu_mi.calibration.light.light_estimate import FoundGains, LightEstimate
    from svu_mi.calibration.light.light_folder import load_light, save_light
    from svu_mi.calibration.light.light_options import LightOptions
    from svu_mi.calibration.light.resolve_light import with_light
    from svu_mi.capture.capture import Capture
    from svu_mi.capture.importers.import_capture import ImportOptions, import_capture
    from svu_mi.capture.importers.registry import read_source
    from svu_mi.capture.importers.source import Light
    from svu_mi.capture.loading import load_capture
    from svu_mi.capture.rendering import render_capture
    from svu_mi.errors import SvuError, SvuWarning
    from svu_mi.evaluation.reference import Reference
    from svu_mi.evaluation.traced_posterior import reference_posterior
    from svu_mi.frequency.fit_sh import fit_sh
    from svu_mi.frequency.harmonics import power_spectrum
    from svu_mi.geometry.texels import Texels, texels
    from svu_mi.guidance.candidates import Candidates
    from svu_mi.guidance.guidance_options import GuidanceOptions
    from svu_mi.guidance.guidance_result import Guidance
    from svu_mi.guidance.next_view import next_best_view
    from svu_mi.output.compare.differences import Comparison, compare
    from svu_mi.output.export.asset import Asset
    from svu_mi.output.export.load_asset import load_asset
    from svu_mi.output.export.write_asset import ExportOptions, export_asset
    from svu_mi.output.report.report import write_report
    from svu_mi.pipeline import Estimate, estimate
    from svu_mi.posterior.angular import angular_posterior
    from svu_mi.posterior.calibrated import calibrated_posterior
    from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
    from svu_mi.posterior.posterior import Posterior
    from svu_mi.posterior.spectrum import spectrum_posterior
    from svu_mi.presets import AngularPreset, Fit, Preset, Skip, preset
    from svu_mi.recovery.inpaint.diffusion.fill_by_diffusion import fill_by_diffusion
    from svu_mi.recovery.inpaint.diffusion.model_interface import DiffusionOptions
    from svu_mi.recovery.inpaint.fill import fill
    from svu_mi.recovery.inpaint.fill_result import Filled
    from svu_mi.recovery.recover import Recovery, recover
    from svu_mi.recovery.recovery_options import DescentOptions, PathOptions, ShOptions
    from svu_mi.recovery.regularizers.global_sharing import GlobalSharing
    from svu_mi.recovery.regularizers.total_variation import TotalVariation

__version__ = "0.1.0"

_HOME = {
    "Capture": "capture.record", "load_capture": "capture.loading",
    "render_capture": "capture.rendering", "Texels": "surface.layout", "texels": "surface.layout",
    "ImportOptions": "formats.importing", "import_capture": "formats.importing",
    "read_source": "formats.reading", "Light": "formats.source", "fit_sh": "frequency.fit",
    "power_spectrum": "frequency.harmonics", "ParameterGrid": "posterior.grid",
    "PrincipledGrid": "posterior.grid", "Posterior": "posterior.posterior",
    "angular_posterior": "posterior.angular", "calibrated_posterior": "posterior.calibrated",
    "spectrum_posterior": "posterior.spectrum", "AngularPreset": "options", "Fit": "options",
    "Preset": "options", "Skip": "options", "preset": "options", "Check": "checking.record",
    "check": "checking.run", "Candidates": "guidance.candidates", "Guidance": "guidance.result",
    "GuidanceOptions": "guidance.options", "next_best_view": "guidance.next_view",
    "Estimate": "pipeline", "estimate": "pipeline", "LightEstimate": "illumination.record",
    "LightOptions": "illumination.options", "FoundGains": "illumination.record",
    "estimate_gains": "illumination.exposure", "equalized": "illumination.exposure",
    "estimate_light": "illumination.estimate", "with_light": "illumination.resolve_light",
    "load_light": "illumination.folder", "save_light": "illumination.folder",
    "Comparison": "output.compare", "compare": "output.compare",
    "write_report": "output.report.report", "Reference": "reference.record",
    "reference_posterior": "reference.posterior", "Recovery": "recovery.recover",
    "recover": "recovery.recover", "TextureField": "recovery.field.field",
    "texture_field": "recovery.field.field", "Filled": "inpaint.fill_result",
    "fill": "inpaint.fill", "DiffusionOptions": "inpaint.diffusion.model_interface",
    "fill_by_diffusion": "inpaint.diffusion.fill", "RelitView": "recovery.relight",
    "relight_draws": "recovery.relight", "DescentOptions": "recovery.options",
    "PathOptions": "recovery.options", "ShOptions": "recovery.options",
    "GlobalSharing": "regularization.sharing", "TotalVariation": "regularization.tv",
    "Asset": "export.asset", "ExportOptions": "export.export", "export_asset": "export.export",
    "load_asset": "export.reading", "SvuError": "errors", "SvuWarning": "errors",
}  # fmt: skip

__all__ = [  # noqa: PLE0604 - the names are loaded on first use
    "AngularPreset", "Asset", "Candidates", "Capture", "Check", "Comparison", "DescentOptions",
    "DiffusionOptions", "Estimate", "ExportOptions", "Filled", "Fit", "FoundGains", "GlobalSharing",
    "Guidance", "GuidanceOptions", "ImportOptions", "Light", "LightEstimate", "LightOptions",
    "ParameterGrid", "PathOptions", "Posterior", "Preset", "PrincipledGrid", "Recovery",
    "Reference", "RelitView", "ShOptions", "Skip", "SvuError", "SvuWarning", "Texels",
    "TextureField", "TotalVariation", "angular_posterior", "calibrated_posterior", "check",
    "compare", "equalized", "estimate", "estimate_gains", "estimate_light", "export_asset", "fill",
    "fill_by_diffusion", "fit_sh", "import_capture", "load_asset", "load_capture",
    "load_light", "next_best_view", "power_spectrum", "preset", "read_source", "recover",
    "reference_posterior", "relight_draws", "render_capture", "save_light", "spectrum_posterior",
    "texels", "texture_field", "with_light", "write_report",
]  # fmt: skip

_llvm.bootstrap()
limits.bootstrap()


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'svu_mi' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"svu_mi.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(_HOME))
