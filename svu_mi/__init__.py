"""Uncertainty for SVBRDF acquisition using frequency analysis, on Mitsuba 3 and Dr.Jit.

``import svu_mi as svu`` only selects an LLVM library (``svu_mi._llvm``); on a single core, it also
imports Dr.Jit. Public names are imported on first use. No Mitsuba variant is set.
"""

import importlib
from contextlib import suppress
from inspect import isfunction
from typing import TYPE_CHECKING, Any

from svu_mi import _llvm
from svu_mi.core.memory import cores

if TYPE_CHECKING:
    from svu_mi.calibration.checks.check import check
    from svu_mi.calibration.checks.check_result import Check
    from svu_mi.calibration.exposure import equalized, estimate_gains
    from svu_mi.calibration.light.estimate_light import estimate_light
    from svu_mi.calibration.light.light_estimate import FoundGains, LightEstimate
    from svu_mi.calibration.light.light_folder import load_light, save_light
    from svu_mi.calibration.light.light_options import LightOptions
    from svu_mi.calibration.light.resolve_light import with_light
    from svu_mi.calibration.poses.refine_poses import RefinedPoses, refine_poses
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
    from svu_mi.pipeline import estimate
    from svu_mi.posterior.angular import angular_posterior
    from svu_mi.posterior.calibrated import calibrated_posterior
    from svu_mi.posterior.estimate import Estimate
    from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
    from svu_mi.posterior.posterior import Posterior
    from svu_mi.posterior.spectrum import spectrum_posterior
    from svu_mi.presets import AngularPreset, Fit, Preset, Skip, preset
    from svu_mi.recovery.inpaint.diffusion.fill_by_diffusion import fill_by_diffusion
    from svu_mi.recovery.inpaint.diffusion.model_interface import DiffusionOptions
    from svu_mi.recovery.inpaint.fill import fill
    from svu_mi.recovery.inpaint.fill_result import Filled
    from svu_mi.recovery.recover import recover
    from svu_mi.recovery.recovery_options import DescentOptions, PathOptions, ShOptions
    from svu_mi.recovery.recovery_result import Recovery
    from svu_mi.recovery.regularizers.global_sharing import GlobalSharing
    from svu_mi.recovery.regularizers.texture_parameters import texture_parameters
    from svu_mi.recovery.regularizers.total_variation import TotalVariation

__version__ = "0.1.0"

_HOME = {
    "Capture": "capture.capture", "load_capture": "capture.loading",
    "render_capture": "capture.rendering", "Texels": "geometry.texels", "texels": "geometry.texels",
    "ImportOptions": "capture.importers.import_capture",
    "import_capture": "capture.importers.import_capture",
    "read_source": "capture.importers.registry", "Light": "capture.importers.source",
    "fit_sh": "frequency.fit_sh", "power_spectrum": "frequency.harmonics",
    "ParameterGrid": "posterior.grid", "PrincipledGrid": "posterior.grid",
    "Posterior": "posterior.posterior", "angular_posterior": "posterior.angular",
    "calibrated_posterior": "posterior.calibrated", "spectrum_posterior": "posterior.spectrum",
    "AngularPreset": "presets", "Fit": "presets", "Preset": "presets", "Skip": "presets",
    "preset": "presets", "Check": "calibration.checks.check_result",
    "check": "calibration.checks.check", "Candidates": "guidance.candidates",
    "Guidance": "guidance.guidance_result", "GuidanceOptions": "guidance.guidance_options",
    "next_best_view": "guidance.next_view", "Estimate": "posterior.estimate",
    "estimate": "pipeline", "LightEstimate": "calibration.light.light_estimate",
    "LightOptions": "calibration.light.light_options",
    "FoundGains": "calibration.light.light_estimate", "estimate_gains": "calibration.exposure",
    "equalized": "calibration.exposure", "estimate_light": "calibration.light.estimate_light",
    "with_light": "calibration.light.resolve_light", "load_light": "calibration.light.light_folder",
    "save_light": "calibration.light.light_folder",
    "RefinedPoses": "calibration.poses.refine_poses",
    "refine_poses": "calibration.poses.refine_poses", "Comparison": "output.compare.differences",
    "compare": "output.compare.differences", "write_report": "output.report.report",
    "Reference": "evaluation.reference", "reference_posterior": "evaluation.traced_posterior",
    "Recovery": "recovery.recovery_result", "recover": "recovery.recover",
    "TextureField": "recovery.uncertainty.texture_field",
    "texture_field": "recovery.uncertainty.texture_field", "Filled": "recovery.inpaint.fill_result",
    "fill": "recovery.inpaint.fill",
    "DiffusionOptions": "recovery.inpaint.diffusion.model_interface",
    "fill_by_diffusion": "recovery.inpaint.diffusion.fill_by_diffusion",
    "RelitView": "recovery.relighting", "relight_draws": "recovery.relighting",
    "DescentOptions": "recovery.recovery_options", "PathOptions": "recovery.recovery_options",
    "ShOptions": "recovery.recovery_options",
    "GlobalSharing": "recovery.regularizers.global_sharing",
    "texture_parameters": "recovery.regularizers.texture_parameters",
    "TotalVariation": "recovery.regularizers.total_variation", "Asset": "output.export.asset",
    "ExportOptions": "output.export.write_asset", "export_asset": "output.export.write_asset",
    "load_asset": "output.export.load_asset", "SvuError": "errors", "SvuWarning": "errors",
}  # fmt: skip

__all__ = [  # noqa: PLE0604 - the names are loaded on first use
    "AngularPreset", "Asset", "Candidates", "Capture", "Check", "Comparison", "DescentOptions",
    "DiffusionOptions", "Estimate", "ExportOptions", "Filled", "Fit", "FoundGains", "GlobalSharing",
    "Guidance", "GuidanceOptions", "ImportOptions", "Light", "LightEstimate", "LightOptions",
    "ParameterGrid", "PathOptions", "Posterior", "Preset", "PrincipledGrid", "Recovery",
    "Reference", "RefinedPoses", "RelitView", "ShOptions", "Skip", "SvuError", "SvuWarning",
    "Texels", "TextureField", "TotalVariation", "angular_posterior", "calibrated_posterior",
    "check", "compare", "equalized", "estimate", "estimate_gains", "estimate_light", "export_asset",
    "fill", "fill_by_diffusion", "fit_sh", "import_capture", "load_asset", "load_capture",
    "load_light", "next_best_view", "power_spectrum", "preset", "read_source", "recover",
    "reference_posterior", "refine_poses", "relight_draws", "render_capture", "save_light",
    "spectrum_posterior", "texels", "texture_field", "texture_parameters", "with_light",
    "write_report",
]  # fmt: skip

_llvm.bootstrap()
if cores() < 2:  # Mitsuba needs two threads
    with suppress(ImportError):  # svu doctor reports a broken installation
        from svu_mi.core.threads import ensure_threads

        ensure_threads()


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'svu_mi' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"svu_mi.{_HOME[name]}"), name)
    if isfunction(value):
        value = importlib.import_module("svu_mi.core.checked_arguments").checked(value)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(_HOME))
