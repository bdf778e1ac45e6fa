"""What Mitsuba's loop minimises: the difference of rendered pixels and photographed ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.capture import Capture
from svu_mi.capture.trust import own_plugin
from svu_mi.errors import ShapeError
from svu_mi.recovery.options import PathOptions
from svu_mi.recovery.path.gradient import PathGradient
from svu_mi.recovery.path.losses import LOSSES
from svu_mi.recovery.path.rays import PixelBatches
from svu_mi.recovery.path.scene import PathScene
from svu_mi.recovery.textures import Textures, uniform
from svu_mi.regularization.gradients import known
from svu_mi.surface import Texels
from svu_mi.visibility.views import Views


@dataclass(frozen=True)
class PathObjective:
    """An objective for ``descend``: renders the batch of a step and compares it.

    Attributes:
        target: the scene that is rendered.
        batches: the pixels of each step.
        integrator: the ``mi.Integrator``.
        gradient: computes losses with their gradients; None leaves that to ``mi.render``.
        options: how it was made.
    """

    target: PathScene
    batches: PixelBatches
    integrator: Any
    gradient: PathGradient | None
    options: PathOptions

    @property
    def steps(self) -> int:
        """Number of steps of ``options.epochs`` epochs, at least 1."""
        return max(1, math.ceil(self.options.epochs * self.batches.epoch))

    def render(self, textures: Mapping[str, Any], step: int) -> tuple[Any, Any]:
        """Return (render, photograph) of a step: two TensorXf (1, N, 3), linear radiance.

        The render is differentiable in the textures. A step's paths are always the same; those
        of its gradient are others, so that their errors are independent.
        """
        self.target.paint(textures)
        photograph, sensor = self.batches.at(step)
        render = mi.render(
            self.target.scene,
            self.target.params,
            sensor=sensor,
            integrator=self.integrator,
            spp=self.options.spp,
            seed=_seed(self.options.seed, step),
        )
        return render, photograph

    def __call__(self, textures: dict[str, Any], step: int) -> Any:
        """Return the loss of a step's batch, in units of the photographs' mean radiance."""
        # Opaque: as a literal, every capture would compile kernels of its own.
        scale = dr.opaque(mi.Float, self.batches.mean or 1.0)
        if self.gradient is None:
            render, photograph = self.render(textures, step)
            return LOSSES[self.options.loss](render.array, photograph.array, scale)
        self.target.paint({name: dr.detach(texture) for name, texture in textures.items()})
        photograph, sensor = self.batches.at(step)
        seed = _seed(self.options.seed, step)
        loss, gradients = self.gradient(tuple(textures), photograph, sensor, seed, scale)
        return sum(
            known(texture, loss if index == 0 else mi.Float(0), gradients[name])
            for index, (name, texture) in enumerate(textures.items())
        )


def path_objective(
    capture: Capture,
    texels: Texels,
    options: PathOptions,
    *,
    fixed: Textures | None = None,
    views: Views | None = None,
) -> PathObjective:
    """Make the objective of a capture.

    Args:
        capture: photographs, scene and light.
        texels: of ``capture.mesh``; they say how large the textures are.
        options: batches, paths and loss.
        fixed: values of parameters that the objective is not given; 0.5 by default.
        views: the views as ``pack_views`` lays them out, if that was done already.

    Raises:
        ShapeError: ``fixed`` has another resolution than the texels.
        CaptureError: no pixel that can be used.
    """
    fixed = uniform(texels) if fixed is None else fixed
    if fixed.resolution != texels.resolution:
        raise ShapeError(
            f"Fixed textures must have the texels' resolution {texels.resolution}, got "
            f"{fixed.resolution}."
        )
    target = PathScene.of(capture, fixed)
    integrator = own_plugin({"type": "prb", "max_depth": options.max_depth})
    gradient = None
    if options.halves and options.spp % 2 == 0:
        gradient = PathGradient(target, integrator, LOSSES[options.loss], options.spp)
    return PathObjective(
        target=target,
        batches=PixelBatches(
            capture, options.pixels_per_batch, options.seed, views, tile=options.tile
        ),
        integrator=integrator,
        gradient=gradient,
        options=options,
    )


def _seed(seed: int, step: int) -> Any:
    """Return the seed of a step's paths; opaque, or every step would compile a kernel."""
    return dr.opaque(mi.UInt32, (seed * 0x9E3779B1 + step + 1) % 2**32)
