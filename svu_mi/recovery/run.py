"""One recovery under way: what is prepared, what starts, and what is descended on."""

from __future__ import annotations

from dataclasses import replace

from svu_mi.errors import OptionError
from svu_mi.observed import Observed
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate
from svu_mi.progress import Progress
from svu_mi.recovery.checkpoint import Checkpoint
from svu_mi.recovery.descent import Descent, Objective, descend
from svu_mi.recovery.options import Method, Options, PathOptions, ShOptions
from svu_mi.recovery.path.objective import path_objective
from svu_mi.recovery.regularized import Rule, each, regularized
from svu_mi.recovery.relight import path_length
from svu_mi.recovery.sh.fit import Fits
from svu_mi.recovery.sh.materials import Materials, MaterialSharing
from svu_mi.recovery.textures import Textures, lay_out, scene_textures, uniform
from svu_mi.regularization import GlobalSharing, TotalVariation
from svu_mi.surface import Texels
from svu_mi.surface.neighbors import neighbors


class Run:
    """One recovery: its parts are made when they are first needed."""

    def __init__(
        self, observed: Observed, names: tuple[str, ...], options: Options,
        start: Textures | None, sharing: GlobalSharing | bool, progress: Progress,
    ) -> None:
        self.observed, self.names = observed, names
        self.capture, self.texels = observed.capture, observed.texels
        self.options, self.start, self.progress = options, start, progress
        self.fits = Fits(observed)
        with progress.stage("Finding neighbours"):
            self.around = neighbors(self.texels, self.capture.mesh)
            self.variation = each(TotalVariation(self.texels, self.around))
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
            data = self.fits.objective(options)
        rule = self._sharing(options)
        if options.loss == "statistics" and options.closed_form and self.start is None:
            values = self.fits.fit(options).start.table()
            if self.materials is not None:
                values = self.materials.blend(values)
            found = self.fits.textures(values)
            start = replace(found, **{n: t for n, t in start.items() if n not in self.names})
        return self._descend("Descending (SH)", start, data, options, rule, checkpoint)

    def _path(self, start: Textures, checkpoint: Checkpoint | None) -> tuple[Textures, Descent]:
        options = self.options.path
        if options.max_depth is None:
            options = replace(options, max_depth=path_length(self.capture.scene))
        with self.progress.stage("Preparing rays"):
            data = path_objective(
                self.capture, self.texels, options, fixed=start, views=self.observed.views
            )
        options = replace(options, descent=replace(options.descent, steps=data.steps))
        rule = self._sharing(options)
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
        found = Textures(**(fixed | descent.values))
        # Nothing pulls gutters along where texels alone are compared.
        return lay_out(self.texels, {name: found.at(self.texels, name) for name in NAMES}), descent

    def _sharing(self, options: ShOptions | PathOptions) -> Rule | None:
        """Return what pulls uncertain texels: materials, or the paper's Eq. 14 and 15."""
        if not self.sharing or not options.sharing:
            return None
        if isinstance(self.sharing, GlobalSharing):
            return each(self.sharing)
        if not options.materials:
            certain = estimate(self.observed, progress=self.progress)
            with self.progress.stage("Finding seeds"):
                return each(GlobalSharing(
                    certain, self.around, divergence="forward", anchored=False
                ))  # fmt: skip
        with self.progress.stage("Finding materials"):
            sh = self.options.sh
            if self.materials is None:
                self.materials = self.fits.materials(sh, self.around)
            return MaterialSharing.of(self.materials, self.fits.fit(sh).loss.place)

    def _known(self) -> Textures:
        """Return textures to start from: 0.5, and what the scene says of other parameters."""
        if len(self.names) == len(NAMES):
            return uniform(self.texels)
        own = scene_textures(self.capture, self.texels)
        return replace(own, **{n: t for n, t in uniform(self.texels).items() if n in self.names})


def require_resolution(texels: Texels, start: Textures | None) -> None:
    """Refuse texels that make no texture, or none like the one to start from.

    Raises:
        OptionError: fewer than 2 per side.
        ShapeError: another resolution than that of ``start``.
    """
    if min(texels.resolution) < 2:
        width, height = texels.resolution
        raise OptionError(
            f"Textures need at least 2 texels per side, got {width} x {height}; lay out more."
        )
    if start is not None:
        start.require_resolution(texels)
