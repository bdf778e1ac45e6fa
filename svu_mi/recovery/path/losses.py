"""How wrong rendered pixels are: one number for a batch, differentiable in the renders.

All of them divide radiances by a ``scale``, such as the mean radiance of the photographs: what
they return, and thus what a learning rate or the weight of a regulariser means, is then the
same at any exposure.

Renders are noisy, and the expectation of a loss is not the loss of the expectation. With a
render r = R + e of an unbiased estimate R and a photograph y:

* ``l2``: E (r - y)^2 = (R - y)^2 + var(r). With gradients from paths of their own (as
  ``mi.render`` has them), the gradient's expectation is that of (R - y)^2: no bias.
* ``l1``: E |r - y| has its minimum where y is the *median* of r; rendered light is skewed, so
  radiance comes out too bright the fewer paths there are. Outliers weigh less, though.
* ``relative``: (r - y)^2 / (y^2 + floor): as ``l2``, with weights that depend on the photograph
  alone. Dividing by the render instead would bring the bias back; noise of the photograph
  brings one of its own, since pixels that came out too dark weigh more (5 % too dark at 16
  samples per pixel).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import drjit as dr

FLOOR = 0.1  # of the relative loss: radiance, in units of the scale, that counts as dark


def l1(render: Any, target: Any, scale: Any = 1.0) -> Any:
    """Mean absolute error, mean |r - y| / s: the paper's loss.

    Args:
        render: (..., C) TensorXf, radiance r.
        target: the same shape, photographed radiance y.
        scale: radiance s that stands for 1; a float, or an opaque Float.
    """
    return dr.mean(dr.abs(render - target), axis=None) / scale


def l2(render: Any, target: Any, scale: Any = 1.0) -> Any:
    """Mean squared error, mean (r - y)^2 / s^2. Arguments as in ``l1``."""
    return dr.mean(dr.square(render - target), axis=None) / dr.square(scale)


def relative(render: Any, target: Any, scale: Any = 1.0) -> Any:
    """Mean of (r - y)^2 / (y^2 + (s FLOOR)^2): dark pixels count as much as bright ones.

    Arguments as in ``l1``.
    """
    weight = dr.rcp(dr.square(target) + dr.square(scale * FLOOR))
    return dr.mean(dr.square(render - target) * weight, axis=None)


LOSSES: Mapping[str, Callable[..., Any]] = MappingProxyType(
    {"l1": l1, "l2": l2, "relative": relative}
)
