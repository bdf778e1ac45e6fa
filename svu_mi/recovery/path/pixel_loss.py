"""Loss of recovery by path tracing: rendered pixels compared with photographs.

Losses divide radiance by a ``scale``, such as the mean radiance of the photographs. Learning rates
and weights of regularisers are thus independent of the exposure.

Monte Carlo noise can bias a loss. For a render r with expectation R and a photograph y:

* ``l2``: E (r - y)^2 = (R - y)^2 + var(r). With independent paths for the gradient, its
  expectation is the gradient of (R - y)^2: no bias.
* ``l1``: E |r - y| is minimal if y is the *median* of r. The distribution of r is skewed, so
  recovered radiance is too bright, in particular with few paths. It is robust to outliers.
* ``relative``: (r - y)^2 / (y^2 + floor): ``l2`` with weights that depend on the photograph only.
  The render in the denominator would cause a bias. Noise of the photograph still causes a bias:
  pixels that are too dark get larger weights (5 % too dark at 16 samples per pixel).

Gradient and loss need independent paths. The paths of a pixel can be split into halves A and B, so
that the gradient of each half uses the loss of the other. This saves a pass:

    gradient = l'(A) dB + l'(B) dA,

where A and B are mean radiances, and l' is the derivative of a pixel's loss.
"""

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

FLOOR = 0.1  # radiance in units of the scale below which weights of ``relative`` are constant


def l1(render: Any, target: Any, scale: Any = 1.0) -> Any:
    """Return mean |r - y| / s, the paper's loss."""
    return dr.mean(dr.abs(render - target), axis=None) / scale


def l2(render: Any, target: Any, scale: Any = 1.0) -> Any:
    """Return mean (r - y)^2 / s^2."""
    return dr.mean(dr.square(render - target), axis=None) / dr.square(scale)


def relative(render: Any, target: Any, scale: Any = 1.0) -> Any:
    """Return mean (r - y)^2 / (y^2 + (s FLOOR)^2), the relative squared error."""
    weight = dr.rcp(dr.square(target) + dr.square(scale * FLOOR))
    return dr.mean(dr.square(render - target) * weight, axis=None)


LOSSES: dict[str, Callable[..., Any]] = {"l1": l1, "l2": l2, "relative": relative}


@dataclass(frozen=True)
class PathObjective:
    """Objective for ``descend``: renders a batch of pixels, compares with photographs.

    Attributes:
        target: Scene to render, with exchangeable textures.
        batches: Pixels of each step.
        integrator: Mitsuba integrator that replays paths, such as ``prb``.
        options: Loss, paths per pixel, epochs and seed.
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
        """Number of parts of a pixel's paths: 2 with ``options.halves`` and even ``spp``."""
        return 2 if self.options.halves and self.options.spp % 2 == 0 else 1

    def __call__(self, textures: dict[str, Any], step: int) -> Any:
        """Return the loss of a step, relative to the mean radiance of the photographs."""
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
            if self.halves == 1:  # new paths, independent of the loss
                place, (_, _, replay) = lane // part, self._trace(batch, seed ^ 0x9E3779B9)
            else:
                place = (lane // part) ^ 1
            replay(dr.gather(mi.Color3f, slope, place) / part)
            dr.eval(loss)
        gradients = [dr.grad(texture).array for texture in live.values()]
        dr.eval(gradients)
        self._toggle_grad(live, dr.disable_grad)
        return with_known_gradient(loss, gradients, [tensor.array for tensor in textures.values()])

    def _trace(self, batch: PixelBatch, seed: Any) -> tuple[Any, Any, Callable[[Any], None]]:
        """Trace a batch; return rendered and photographed radiance, and the backward pass.

        Radiance is two Floats (3 N ``halves``,): RGB, for both halves of a pixel. The backward
        pass is a function: its argument is dloss / dradiance of each path, Color3f.
        """
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
        """Return the loss, and its derivatives with respect to ``radiance``."""
        # Opaque, because a literal would compile new kernels for every capture.
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
        """Return the seed of a step's paths, opaque to reuse kernels between steps."""
        return dr.opaque(mi.UInt32, (self.options.seed * 0x9E3779B1 + step + 1) % 2**32)


def path_objective(
    capture: Capture,
    texels: Texels,
    options: PathOptions,
    *,
    fixed: Textures | None = None,
    views: Views | None = None,
) -> PathObjective:
    """Return the objective of a capture; ``fixed`` contains textures not to optimise."""
    return PathObjective(
        target=PathScene.of(capture, uniform_textures(texels) if fixed is None else fixed),
        batches=PixelBatches(capture, options.pixels_per_batch, options.seed, views),
        integrator=own_plugin({"type": "prb", "max_depth": options.max_depth}),
        options=options,
    )
