"""SVBRDF recovery: photographs in, textures out. The file to read first.

sh:       capture -> estimate -> posterior means -> smoothed -> descent
path:     capture -> batches of rays -> prb (Mitsuba)        -> descent
sh+path:  the first, then one epoch of the second
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.geometry.neighbors import Neighbors
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import NAMES
from svu_mi.posterior.estimate import Estimate, capture_and_texels, observations_of
from svu_mi.posterior.observations import Observed
from svu_mi.recovery.recovery_options import Method, PathOptions, ShOptions, method_options
from svu_mi.recovery.recovery_run import RecoveryRun, require_resolution
from svu_mi.recovery.regularizers.global_sharing import GlobalSharing
from svu_mi.recovery.svbrdf_textures import Textures


@dataclass(frozen=True, kw_only=True, repr=False)
class Recovery:
    """Recovered textures, and how they came about.

    Attributes:
        method: what they were recovered by.
        texels: the T texels they belong to.
        textures: base colour, roughness and metallic.
        coverage: (T,) uint32, number of photographs that show each texel; where it is 0, values
            come from neighbours and, if shared, from texels that look alike.
        losses: (N,) float32, of the last descent, before each step.
        stopped: why that ended: ``finished`` or ``converged``.
        settings: everything the result depends on, besides the capture.
        timings: seconds per stage, synchronised.
        estimate: what was known of every texel by itself, or with a prior in common, where
            the recovery asked; None where it did not (``path``, losses of the paper).
        around: neighbours of the texels, if they were looked for.
    """

    method: Method
    texels: Texels
    textures: Textures
    coverage: np.ndarray
    losses: np.ndarray
    stopped: str
    settings: dict[str, Any]
    timings: dict[str, float] = field(default_factory=dict)
    estimate: Estimate | None = field(default=None, repr=False)
    around: Neighbors | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        width, height = self.texels.resolution
        return (
            f"<Recovery {self.method}: textures of {width} x {height}, {self.texels.count} texels, "
            f"{self.stopped} after {len(self.losses)} steps>"
        )

    def image(self, name: str) -> np.ndarray:
        """Return a map as (H, W) or (H, W, 3) float32: a texture, or ``coverage``.

        Raises:
            OptionError: an unknown name.
        """
        if name == "coverage":
            return self.texels.to_image(self.coverage.astype(np.float32), 0.0)
        if name not in NAMES:
            raise OptionError(
                f"Recovery.image(): there is no map {name!r}; use {', '.join(NAMES)} or coverage; "
                "Recovery.estimate.image() has entropy and standard deviations."
            )
        values = np.array(getattr(self.textures, name))
        return values if values.shape[2] > 1 else values[..., 0]


def recover(
    source: Capture | Observed | Estimate, texels: Texels | None = None, method: Method = "sh",
    preset: str = "default", *, sharing: GlobalSharing | bool = False, tv: float | None = None,
    parameters: Sequence[str] = NAMES, start: Textures | None = None, sh: ShOptions | None = None,
    path: PathOptions | None = None, checkpoint: str | Path | None = None, resume: bool = False,
    checkpoint_seconds: float = 30.0, progress: Progress | None = None,
) -> Recovery:  # fmt: skip
    """Recover the textures of an object from its photographs (Sec. 5.2 to 5.4 of the paper).

    Args:
        source: a capture; or an estimate of one, whose rays are not traced again. ``sh`` goes on
            from the posterior of an estimate in colour (``default``); others are made again with
            their reflection model. Parameters that it takes as known stay as they are.
        texels: texels of ``capture.mesh``, textures have their resolution; may be left out with
            an estimate.
        method: ``sh`` compares photographs with a reflection model; ``path`` with renderings by
            Mitsuba's ``prb``; ``sh+path`` continues the first with one epoch of the second.
        preset: ``default`` or ``paper``; ``coefficients`` and ``spectrum`` are the paper's other
            losses, of ``sh`` and of that part of ``sh+path``, whose epoch is then the paper's, too.
            For ``path``, also ``polish`` and ``paper_polish``, those epochs by themselves.
        sharing: let uncertain texels be like others. True learns a prior that texels have in common
            (``posterior/empirical_bayes.py``); with presets of the paper's, it is Eq. 14 and 15 as
            printed, by the posterior of Eq. 11: that of ``source`` if it is one over (roughness,
            Ks), or one made for it. Or a ``GlobalSharing`` of one's own making.
        tv: weight of total variation, instead of the options'.
        parameters: names of the textures to recover; others are those of ``start``, or the scene's.
        start: textures to start from, instead of the closed form (sh) or of 0.5 (path).
        sh: options of ``sh``, instead of the preset's.
        path: options of ``path``, likewise.
        checkpoint: file that states of the last descent are saved to.
        resume: continue from that file, if there is one.
        checkpoint_seconds: between two states.
        progress: shows the stages and collects timings.

    Raises:
        OptionError: an unknown method or parameter, a preset that the method does not have, a
            checkpoint of another run.
        ShapeError: ``start`` has another resolution than the texels.
        CaptureError: no texel is seen in any photograph.
        SvuError: the loss or a gradient is NaN or infinite.
        OutputError: the checkpoint cannot be read or written.
    """
    if resume and checkpoint is None:
        raise OptionError("recover(): resume=True needs a checkpoint to resume from.")
    names = _checked(method, sharing, parameters)
    options, progress = method_options(method, preset, sh, path, tv), progress or Progress()
    require_resolution(capture_and_texels(source, texels)[1], start)
    observed = observations_of(source, texels, progress)
    with progress.stage("Reading the light"):
        _ = observed.lighting  # refused before any work: a black light shows nothing
    given = source if isinstance(source, Estimate) else None
    run = RecoveryRun(method, observed, given, names, options, start, sharing, progress)
    saved = None if checkpoint is None else run.checkpoint(checkpoint, resume, checkpoint_seconds)
    textures, descent = run.run(saved)
    return Recovery(
        method=run.method, texels=run.texels, textures=textures, coverage=run.observed.coverage,
        losses=descent.losses, stopped=descent.stopped, settings=run.settings,
        timings=run.progress.timings, estimate=run.estimate if run.asked else None,
        around=run.found_neighbors,
    )  # fmt: skip


def _checked(
    method: str, sharing: GlobalSharing | bool, parameters: Sequence[str]
) -> tuple[str, ...]:
    """Refuse what makes no sense; return the names of parameters in their usual order."""
    if method not in get_args(Method):
        raise OptionError(f"Unknown method {method!r}; use one of {', '.join(get_args(Method))}.")
    if not isinstance(sharing, bool | GlobalSharing):
        raise OptionError(
            f"recover(): sharing must be True, False or a GlobalSharing, got {sharing!r}; weights "
            "are options (sh=, path=)."
        )
    unknown = [name for name in parameters if name not in NAMES]
    if unknown or not parameters:
        raise OptionError(
            f"recover(): parameters must be one or more of {', '.join(NAMES)}, got "
            f"{', '.join(map(str, parameters)) or 'none'}."
        )
    return tuple(name for name in NAMES if name in parameters)
