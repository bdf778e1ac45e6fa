"""SVBRDF recovery: photographs in, textures out. The file to read first.

    sh:       capture -> texels -> statistics -> closed-form start -> descent
    path:     capture -> batches of rays ->  prb (Mitsuba)         -> descent
    sh+path:  the first, then one epoch of the second
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.errors import OptionError
from svu_mi.pipeline import estimate
from svu_mi.progress import Progress
from svu_mi.recovery.checkpoint import Checkpoint
from svu_mi.recovery.descent import Descent, Objective, descend
from svu_mi.recovery.fingerprint import fingerprint
from svu_mi.recovery.options import PathOptions, ShOptions, path_preset, sh_preset
from svu_mi.recovery.path.objective import path_objective
from svu_mi.recovery.sh.materials import Materials, MaterialSharing
from svu_mi.recovery.sh.prepare import Prepared, prepare
from svu_mi.recovery.textures import NAMES, Textures, scene_textures, uniform
from svu_mi.regularization import GlobalSharing, TotalVariation
from svu_mi.surface import Texels
from svu_mi.surface.neighbors import neighbors

Method = Literal["sh", "path", "sh+path"]
Rule = Callable[[dict[str, Any]], Any]


@dataclass(frozen=True, kw_only=True)
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
    """

    method: Method
    texels: Texels
    textures: Textures
    coverage: np.ndarray
    losses: np.ndarray
    stopped: str
    settings: dict[str, Any]
    timings: dict[str, float] = field(default_factory=dict)

    def image(self, name: str) -> np.ndarray:
        """Return a map as (H, W) or (H, W, 3) float32: a texture, or ``coverage``.

        Raises:
            OptionError: an unknown name.
        """
        if name == "coverage":
            return self.texels.to_image(self.coverage.astype(np.float32), 0.0)
        if name not in NAMES:
            raise OptionError(
                f"Recovery.image(): there is no map {name!r}; use {', '.join(NAMES)} or coverage."
            )
        values = np.array(getattr(self.textures, name))
        return values if values.shape[2] > 1 else values[..., 0]


def recover(
    capture: Capture,
    texels: Texels,
    method: Method = "sh",
    preset: str = "default",
    *,
    sharing: GlobalSharing | bool = False,
    tv: float | None = None,
    parameters: Sequence[str] = NAMES,
    start: Textures | None = None,
    sh: ShOptions | None = None,
    path: PathOptions | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    checkpoint_seconds: float = 30.0,
    progress: Progress | None = None,
) -> Recovery:
    """Recover the textures of an object from its photographs (Sec. 5.2 to 5.4 of the paper).

    Args:
        capture: scene, photographs and light.
        texels: texels of ``capture.mesh``; textures have their resolution.
        method: ``sh`` compares photographs with a reflection model; ``path`` with renderings by
            Mitsuba's ``prb``; ``sh+path`` goes on from the result of the first with one epoch
            of the second.
        preset: ``default``, ``paper``, or, for ``sh``, ``coefficients`` or ``spectrum``.
        sharing: let uncertain texels take after certain ones that look like them. True finds the
            object's materials (``sh.materials``; with the paper's losses, seeds as Eq. 14 and
            15 have them); or a regulariser of one's own making.
        tv: weight of total variation, instead of the options'.
        parameters: names of the textures to recover; others stay as ``start``, or the scene's
            own material, has them.
        start: textures to start from, instead of the closed form (sh) or of 0.5 (path).
        sh: options of ``sh``, instead of the preset's.
        path: options of ``path``, instead of the preset's.
        checkpoint: file that states of the last descent are saved to.
        resume: go on from that file, if there is one.
        checkpoint_seconds: between two states.
        progress: shows what is going on and collects timings.

    Raises:
        OptionError: an unknown method, preset or parameter, a checkpoint of another run.
        ShapeError: ``start`` has another resolution than the texels.
        CaptureError: no texel is seen in any photograph.
        SvuError: the loss or a gradient is NaN or infinite.
        OutputError: the checkpoint cannot be read or written.
    """
    if method not in ("sh", "path", "sh+path"):
        raise OptionError(f"Unknown method {method!r}; there are sh, path and sh+path.")
    names = _names(parameters)
    chosen = _Options.of(method, preset, sh, path, tv)
    progress = progress or Progress()
    run = _Run(capture, texels, names, chosen, start, sharing, progress)
    settings = chosen.settings(method) | {"parameters": list(names), "sharing": bool(sharing)}
    saved = None
    if checkpoint is not None:
        owner = settings | fingerprint(capture, start)
        saved = Checkpoint(checkpoint, owner, resume=resume, every=checkpoint_seconds)
    textures, descent = run.run(method, saved)
    return Recovery(
        method=method,
        texels=texels,
        textures=textures,
        coverage=run.prepared.coverage,
        losses=descent.losses,
        stopped=descent.stopped,
        settings=settings,
        timings=progress.timings,
    )


@dataclass(frozen=True)
class _Options:
    sh: ShOptions
    path: PathOptions

    @staticmethod
    def of(
        method: Method, preset: str, sh: ShOptions | None, path: PathOptions | None,
        tv: float | None,
    ) -> _Options:
        """Take the preset's options where none are given."""
        chosen = _Options(
            sh or sh_preset("default" if method == "path" else preset),
            path or path_preset("default" if method == "sh" else preset),
        )
        if method == "sh+path" and path is None:
            # The start is as good as many epochs: what is left is detail, and no cause for noise.
            chosen = replace(chosen, path=path_preset("polish"))
        if tv is not None:
            chosen = _Options(replace(chosen.sh, tv=tv), replace(chosen.path, tv=tv))
        return chosen

    def settings(self, method: Method) -> dict[str, Any]:
        """Return what of the options matters for a method."""
        used = {"sh": ("sh",), "path": ("path",), "sh+path": ("sh", "path")}[method]
        return {"method": method} | {name: asdict(getattr(self, name)) for name in used}


class _Run:
    """One recovery: its parts are made when they are first needed."""

    def __init__(
        self, capture: Capture, texels: Texels, names: tuple[str, ...], options: _Options,
        start: Textures | None, sharing: GlobalSharing | bool, progress: Progress,
    ) -> None:
        self.capture, self.texels, self.names = capture, texels, names
        self.options, self.start, self.progress = options, start, progress
        self._require_resolution()
        with progress.stage("Tracing visibility"):
            self.prepared: Prepared = prepare(capture, texels)
        with progress.stage("Finding neighbours"):
            self.around = neighbors(texels, capture.mesh)
            self.variation = each(TotalVariation(texels, self.around))
        self.sharing = sharing
        self.materials: Materials | None = None

    def run(self, method: Method, checkpoint: Checkpoint | None) -> tuple[Textures, Descent]:
        """Recover by a method; the last descent is the one that is saved."""
        textures = self.start or self._known()
        if method != "path":
            textures, descent = self._sh(textures, checkpoint if method == "sh" else None)
        if method != "sh":
            textures, descent = self._path(textures, checkpoint)
        return textures, descent

    def _sh(self, start: Textures, checkpoint: Checkpoint | None) -> tuple[Textures, Descent]:
        options = self.options.sh
        with self.progress.stage("Gathering statistics"):
            data = self.prepared.objective(options)
        rule = self._sharing(ours=options.loss == "statistics")
        if options.loss == "statistics" and options.closed_form and self.start is None:
            values = self.prepared.fit(options).start.table()
            if self.materials is not None:
                values = self.materials.blend(values)
            found = self.prepared.textures(values)
            start = replace(found, **{n: t for n, t in start.items() if n not in self.names})
        return self._descend("Descending (SH)", start, data, options, rule, checkpoint)

    def _path(self, start: Textures, checkpoint: Checkpoint | None) -> tuple[Textures, Descent]:
        options = self.options.path
        with self.progress.stage("Preparing rays"):
            data = path_objective(
                self.capture, self.texels, options, fixed=start, views=self.prepared.views
            )
        options = replace(options, descent=replace(options.descent, steps=data.steps))
        rule = self._sharing(ours=True)
        return self._descend("Descending (path tracing)", start, data, options, rule, checkpoint)

    def _descend(
        self, title: str, start: Textures, data: Objective, options: ShOptions | PathOptions,
        sharing: Rule | None, checkpoint: Checkpoint | None,
    ) -> tuple[Textures, Descent]:  # fmt: skip
        tensors = dict(start.items())
        fixed = {name: tensor for name, tensor in tensors.items() if name not in self.names}
        free = {name: tensors[name] for name in self.names}
        rules = [(options.tv, self.variation), (options.sharing, sharing)]
        objective = regularized(data, [(w, rule) for w, rule in rules if w and rule], fixed)
        with self.progress.stage(title, options.descent.steps) as stage:
            descent = descend(
                objective, free, options.descent, checkpoint=checkpoint, progress=stage
            )
        return Textures(**(fixed | descent.values)), descent

    def _sharing(self, *, ours: bool) -> Rule | None:
        """Return what pulls uncertain texels: materials, or the paper's Eq. 14 and 15."""
        if isinstance(self.sharing, GlobalSharing):
            return each(self.sharing)
        if not self.sharing:
            return None
        if not ours:
            certain = estimate(self.capture, self.texels, progress=self.progress)
            with self.progress.stage("Finding seeds"):
                return each(GlobalSharing(certain, self.around))
        with self.progress.stage("Finding materials"):
            options = self.options.sh
            if self.materials is None:
                self.materials = self.prepared.materials(options, self.around)
            place = self.prepared.fit(options).loss.place
            return MaterialSharing.of(self.materials, place)

    def _known(self) -> Textures:
        """Return textures to start from: 0.5, and what the scene says of other parameters."""
        if len(self.names) == len(NAMES):
            return uniform(self.texels)
        own = scene_textures(self.capture, self.texels)
        return replace(own, **{n: t for n, t in uniform(self.texels).items() if n in self.names})

    def _require_resolution(self) -> None:
        if self.start is not None:
            self.start.require_resolution(self.texels)


def regularized(
    data: Objective, rules: Sequence[tuple[float, Rule]], fixed: dict[str, Any] | None = None
) -> Objective:
    """Return an objective with regularisers: data + sum of weight * rule(textures).

    Args:
        data: the objective of the photographs.
        rules: pairs of a weight and a function of all textures, by name.
        fixed: textures that the functions need and that are not optimised.
    """
    weights = [dr.opaque(mi.Float, weight) for weight, _ in rules]

    def objective(textures: dict[str, Any], step: int) -> Any:
        loss = data((fixed or {}) | textures, step)
        for weight, (_, rule) in zip(weights, rules, strict=True):
            loss += weight * rule((fixed or {}) | textures)
        return loss

    return objective


def each(rule: Callable[[Any], Any]) -> Rule:
    """Return a regulariser of one texture as one of all: the sum over them."""
    return lambda textures: sum(rule(texture) for texture in textures.values())


def _names(parameters: Sequence[str]) -> tuple[str, ...]:
    unknown = [name for name in parameters if name not in NAMES]
    if unknown or not parameters:
        raise OptionError(
            f"recover(): parameters are one or more of {', '.join(NAMES)}, got "
            f"{', '.join(map(str, parameters)) or 'none'}."
        )
    return tuple(name for name in NAMES if name in parameters)
