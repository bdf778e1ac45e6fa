"""The loss of recovery by path tracing: rendered pixels against photographed ones.

Losses divide radiances by a ``scale``, such as the mean radiance of the photographs, so that
learning rates and weights of regularisers mean the same at any exposure.

Renders are noisy, and the expectation of a loss is not the loss of the expectation. With a
render r = R + e of an unbiased estimate R and a photograph y:

* ``l2``: E (r - y)^2 = (R - y)^2 + var(r). With gradients from paths of their own, the gradient's
  expectation is that of (R - y)^2: no bias.
* ``l1``: E |r - y| has its minimum where y is the *median* of r; rendered light is skewed, so
  radiance comes out too bright the fewer paths there are. Outliers weigh less, though.
* ``relative``: (r - y)^2 / (y^2 + floor): as ``l2``, with weights that depend on the photograph
  alone. Dividing by the render instead would bring the bias back; noise of the photograph
  brings one of its own, since pixels that came out too dark weigh more (5 % too dark at 16
  samples per pixel).

Paths of the gradient are independent of those of the loss. Where the paths of a pixel are parted in
two halves A and B, each is the other's, which saves a pass:

    gradient = l'(A) dB + l'(B) dA,

where A and B are mean radiances, and l' the derivative of a pixel's loss.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.capture.capture import Capture
from svu_mi.capture.plugin_security import own_plugin
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.texels import Texels
from svu_mi.recovery.path.pixel_batches import PixelBatch, PixelBatches
from svu_mi.recovery.path.textured_scene import PathScene, key_of
from svu_mi.recovery.recovery_options import PathOptions
from svu_mi.recovery.regularizers.known_gradient import with_known_gradient
from svu_mi.recovery.svbrdf_textures import Textures, uniform_textures

FLOOR = 0.1  # of the relative loss: radiance, in units of the scale, that counts as dark


def l1(render: Any, target: Any, scale: Any = 1.0) -> Any:
    """Return mean |r - y| / s, the paper's loss."""
    return dr.mean(dr.abs(render - target), axis=None) / scale


def l2(render: Any, target: Any, scale: Any = 1.0) -> Any:
    """Return mean (r - y)^2 / s^2."""
    return dr.mean(dr.square(render - target), axis=None) / dr.square(scale)


def relative(render: Any, target: Any, scale: Any = 1.0) -> Any:
    """Return mean (r - y)^2 / (y^2 + (s FLOOR)^2): dark pixels count as much as bright ones."""
    weight = dr.rcp(dr.square(target) + dr.square(scale * FLOOR))
    return dr.mean(dr.square(render - target) * weight, axis=None)


LOSSES: dict[str, Callable[..., Any]] = {"l1": l1, "l2": l2, "relative": relative}


@dataclass(frozen=True)
class PathObjective:
    """An objective for ``descend``: renders the batch of a step and compares it.

    Attributes:
        target: the scene that is rendered.
        batches: the pixels of each step.
        integrator: ``prb``, or another integrator of Mitsuba's that replays paths.
        options: how it was made.
    """

    target: PathScene
    batches: PixelBatches
    integrator: Any
    options: PathOptions

    @property
    def steps(self) -> int:
        """Number of steps of ``options.epochs`` epochs, at least 1."""
        return max(1, math.ceil(self.options.epochs * self.batches.epoch))

    @property
    def halves(self) -> int:
        """Number of parts of a pixel's paths: 2 where they serve each other, else 1."""
        return 2 if self.options.halves and self.options.spp % 2 == 0 else 1

    def __call__(self, textures: dict[str, Any], step: int) -> Any:
        """Return the loss of a step's batch, in units of the photographs' mean radiance."""
        self.target.paint({name: dr.detach(texture) for name, texture in textures.items()})
        params = self.target.params
        live = {name: params[key_of(name)] for name in textures}
        self._toggle_grad(live, dr.enable_grad)
        with dr.suspend_grad():
            batch, seed = self.batches.at(step), self._seed(step)
            radiance, photograph, replay = self._trace(batch, seed)
            loss, slope = self._loss_and_gradient(radiance, photograph)
            lane = dr.arange(mi.UInt32, len(batch.index) * self.options.spp)
            part = self.options.spp // self.halves
            if self.halves == 1:  # other paths than those of the loss
                place, (_, _, replay) = lane // part, self._trace(batch, seed ^ 0x9E3779B9)
            else:
                place = (lane // part) ^ 1
            replay(dr.gather(mi.Color3f, slope, place) / part)
            dr.eval(loss)
        gradients = {name: dr.grad(texture).array for name, texture in live.items()}
        dr.eval(gradients)
        self._toggle_grad(live, dr.disable_grad)
        return sum(
            with_known_gradient(
                loss if index == 0 else mi.Float(0), [gradients[name]], [texture.array]
            )
            for index, (name, texture) in enumerate(textures.items())
        )

    def render(self, textures: Mapping[str, Any], step: int) -> tuple[Any, Any]:
        """Return radiance of a step, rendered and photographed: (3 N ``halves``,) Floats, RGB by
        RGB, of a pixel all halves."""
        self.target.paint(textures)
        radiance, photograph, _ = self._trace(self.batches.at(step), self._seed(step))
        return radiance, photograph

    def _trace(self, batch: PixelBatch, seed: Any) -> tuple[Any, Any, Callable[[Any], None]]:
        """Trace the paths of a batch: return what ``render`` does, and a function that takes the
        derivative of a loss by the radiance of every path, and passes it on to the textures."""
        count, views = len(batch.index), self.batches.views
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, count * self.options.spp)
        fixed: dict[str, Any] = {
            "scene": self.target.scene, "ray": batch.rays(views, sampler, self.options.spp),
            "depth": mi.UInt32(0), "active": mi.Bool(True),
        }  # fmt: skip
        color, _, _, state = self.integrator.sample(
            mode=dr.ADMode.Primal, sampler=sampler.clone(), δL=None, δaovs=None, state_in=None,
            **fixed,
        )  # fmt: skip
        dr.eval(color, state)

        def replay(change: Any) -> None:
            self.integrator.sample(
                mode=dr.ADMode.Backward, sampler=sampler, δL=change, δaovs=[], state_in=state,
                **fixed,
            )  # fmt: skip

        part = self.options.spp // self.halves
        means = [dr.block_sum(channel, part) / part for channel in color]
        pixel = dr.arange(mi.UInt32, self.halves * count) // self.halves
        index = dr.gather(mi.UInt32, batch.index, pixel)
        seen = dr.gather(mi.Color3f, views.pixels, index)
        return dr.ravel(mi.Color3f(means)), dr.ravel(seen), replay

    def _loss_and_gradient(self, radiance: Any, photograph: Any) -> tuple[Any, Any]:
        """Return the loss, and its derivatives by the radiance."""
        # Opaque: as a literal, every capture would compile kernels of its own.
        scale = dr.opaque(mi.Float, self.batches.mean or 1.0)
        with dr.resume_grad():
            dr.enable_grad(radiance)
            loss = LOSSES[self.options.loss](radiance, photograph, scale)
            dr.backward(loss)
            return dr.detach(loss), dr.grad(radiance)

    def _toggle_grad(self, textures: Mapping[str, Any], change: Callable[[Any], None]) -> None:
        """Enable or disable gradients of textures."""
        for name, texture in textures.items():
            change(texture)
            self.target.params.set_dirty(key_of(name))
        self.target.params.update()

    def _seed(self, step: int) -> Any:
        """Return the seed of a step's paths; opaque, or every step would compile a kernel."""
        return dr.opaque(mi.UInt32, (self.options.seed * 0x9E3779B1 + step + 1) % 2**32)


def path_objective(
    capture: Capture,
    texels: Texels,
    options: PathOptions,
    *,
    fixed: Textures | None = None,
    views: Views | None = None,
) -> PathObjective:
    """Make the objective of a capture."""
    return PathObjective(
        target=PathScene.of(capture, uniform_textures(texels) if fixed is None else fixed),
        batches=PixelBatches(capture, options.pixels_per_batch, options.seed, views),
        integrator=own_plugin({"type": "prb", "max_depth": options.max_depth}),
        options=options,
    )
