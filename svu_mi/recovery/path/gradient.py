"""The gradient of a batch in two passes.

``mi.render`` traces a batch three times: once for the picture, and twice more, with other
paths, for its gradient (``prb``: the radiance first, then its derivatives). The first of these
is saved when the paths of a pixel are parted in two halves A and B that serve each other:

    gradient = l'(A) dB + l'(B) dA,

where A and B are mean radiances, and l' the derivative of a pixel's loss. No path is weighted
by its own error: like ``mi.render``'s, this gradient of a squared loss has no bias.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.errors import OptionError
from svu_mi.recovery.path.scene import PathScene, key_of


class PathGradient:
    """Losses of batches with their gradients by the textures of a scene.

    Attributes:
        target: the scene; its textures are those that were painted last.
        integrator: ``prb``, or another integrator of Mitsuba's that replays paths.
        loss: ``loss(render, target, scale)``, see ``losses``.
        spp: paths per pixel, an even number.
    """

    def __init__(
        self,
        target: PathScene,
        integrator: Any,
        loss: Callable[..., Any],
        spp: int,
    ) -> None:
        """Trace nothing yet; arguments are the attributes.

        Raises:
            OptionError: an odd number of paths, which has no halves.
        """
        if spp < 2 or spp % 2:
            raise OptionError(f"Paths in two halves need an even spp, got {spp}.")
        self.target, self.integrator, self.loss, self.spp = target, integrator, loss, spp

    def __call__(
        self,
        names: Sequence[str],
        photograph: Any,
        sensor: Any,
        seed: Any,
        scale: Any,
    ) -> tuple[Any, dict[str, Any]]:
        """Return the loss of a batch, and its gradient by every texture as (H W C,) Float.

        Args:
            names: the textures to differentiate by.
            photograph: (1, N, 3) TensorXf.
            sensor: that of ``PixelBatches.at``.
            seed: opaque UInt32.
            scale: opaque Float, the radiance that stands for 1.
        """
        params = self.target.params
        textures = {name: params[key_of(name)] for name in names}
        self._follow(textures, dr.enable_grad)
        count = len(sensor.pixel_idx)
        with dr.suspend_grad():
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(seed, count * self.spp)
            # Of the film's row of pixels, the sensor looks at the fraction only.
            at = mi.Point2f(sampler.next_2d()) / mi.ScalarVector2f(sensor.film().crop_size())
            ray, _ = sensor.sample_ray_differential(0, 0, at, 0)
            fixed: dict[str, Any] = {"scene": self.target.scene, "ray": ray, "depth": mi.UInt32(0),
                                     "active": mi.Bool(True)}  # fmt: skip
            radiance, _, _, state = self.integrator.sample(
                mode=dr.ADMode.Primal, sampler=sampler.clone(), δL=None, δaovs=None,
                state_in=None, **fixed,
            )  # fmt: skip
            dr.eval(radiance, state)
            loss, change = self._adjoint(radiance, photograph.array, count, scale)
            self.integrator.sample(
                mode=dr.ADMode.Backward, sampler=sampler, δL=change, δaovs=[],
                state_in=state, **fixed,
            )  # fmt: skip
            dr.eval(loss)
        gradients = {name: dr.grad(texture).array for name, texture in textures.items()}
        dr.eval(gradients)
        self._follow(textures, dr.disable_grad)
        return loss, gradients

    def _follow(self, textures: Mapping[str, Any], change: Callable[[Any], None]) -> None:
        """Let derivatives by textures be followed, or not any more."""
        for name, texture in textures.items():
            change(texture)
            self.target.params.set_dirty(key_of(name))
        self.target.params.update()

    def _adjoint(self, radiance: Any, photograph: Any, count: int, scale: Any) -> tuple[Any, Any]:
        """Return the mean loss of the halves, and what each path's radiance changes in it."""
        part = self.spp // 2
        channels = [dr.block_sum(channel, part) / part for channel in radiance]
        halves = dr.ravel(mi.Color3f(channels))
        index = dr.arange(mi.UInt32, 2 * count)
        seen = dr.ravel(dr.gather(mi.Color3f, photograph, index >> 1))
        with dr.resume_grad():
            dr.enable_grad(halves)
            loss = self.loss(halves, seen, scale)
            dr.backward(loss)
            slope = dr.grad(halves)
        lane = dr.arange(mi.UInt32, count * self.spp)
        # The other half of the same pixel.
        return dr.detach(loss), dr.gather(mi.Color3f, slope, (lane // part) ^ 1) / part
