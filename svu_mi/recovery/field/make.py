"""From recovered textures and what is known of every texel to the field around them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.parameters import CHANNELS, MIXED, NAMES
from svu_mi.pipeline import Estimate
from svu_mi.posterior import CalibratedPosterior
from svu_mi.progress import Progress
from svu_mi.recovery.field.correlations import SUREST, Correlations, prior_sds
from svu_mi.recovery.field.field import COMMON, COMMON_MIXED, TextureField
from svu_mi.recovery.field.smoother import Smoother
from svu_mi.recovery.options import ShOptions
from svu_mi.recovery.recover import Recovery
from svu_mi.recovery.run import HOLD
from svu_mi.recovery.sh.objective import moments
from svu_mi.recovery.textures import Textures
from svu_mi.surface.neighbors import Neighbors, neighbors


def texture_field(
    recovery: Recovery,
    estimate: Estimate | None = None,
    mesh: Any | None = None,
    *,
    progress: Progress | None = None,
) -> TextureField:
    """Return how sure recovered textures are.

    Args:
        recovery: the textures.
        estimate: what is known of every texel by itself; by default the one that the textures were
            recovered from.
        mesh: that the texels lie on (``capture.mesh``), where the recovery has not looked for their
            neighbours; without it, these are those in the map.
        progress: shows what is going on.

    Raises:
        OptionError: there is no estimate in colour that knows its noise.
        ShapeError: the estimate is of texels of another resolution.
    """
    found = recovery.estimate if estimate is None else estimate
    if found is None or not has_field(found):
        raise OptionError(
            "texture_field(): needs an estimate in colour that knows its noise; give "
            "estimate=svu.estimate(capture, texels)."
        )
    recovery.textures.require_resolution(found.texels)
    options = weights_of(recovery.settings)
    with (progress or Progress()).stage("How sure the textures are"):
        around = recovery.around or neighbors(recovery.texels, mesh)
        return field_around(
            recovery.textures, found, around, recovery.settings["parameters"], options
        )


def weights_of(settings: Mapping[str, Any]) -> ShOptions:
    """Return options with the weights of total variation that textures were recovered with
    (``Recovery.settings``): in nats, so of other losses than ours they are our defaults."""
    used = settings.get("sh", {})
    if used.get("loss") != "statistics":
        return ShOptions()
    return ShOptions(tv=used["tv"], tv_epsilon=used["tv_epsilon"])


def has_field(estimate: Estimate) -> bool:
    """Return whether an estimate says enough for ``texture_field``."""
    posterior = estimate.posterior
    colors = CHANNELS["base_color"]
    return isinstance(posterior, CalibratedPosterior) and posterior.groups == colors


def field_of(textures: Textures, estimate: Estimate, mesh: Any) -> TextureField | None:
    """Return the field around textures that somebody has recovered; None where the estimate does
    not say enough for one, or is of other texels.

    Args:
        textures: over the mesh.
        estimate: what is known of every texel by itself.
        mesh: ``capture.mesh``.
    """
    if not has_field(estimate) or textures.resolution != estimate.texels.resolution:
        return None
    return field_around(textures, estimate, neighbors(estimate.texels, mesh))


def field_around(
    textures: Textures, estimate: Estimate, around: Neighbors, names: Sequence[str] = NAMES,
    options: ShOptions | None = None,
) -> TextureField:  # fmt: skip
    """Return the field around textures, whoever recovered them.

    Args:
        textures: over the texels of the estimate.
        estimate: one that ``has_field``.
        around: the texels' neighbours.
        names: of the parameters that are in question.
        options: weights of total variation; ours by default.
    """
    posterior, texels = estimate.posterior, estimate.texels
    assert isinstance(posterior, CalibratedPosterior)
    options = options or ShOptions()
    values = {name: np.atleast_2d(textures.at(texels, name).T).astype(np.float64)
              for name in NAMES}  # fmt: skip
    x0 = np.concatenate(list(values.values()))
    own, deviation = _own(posterior, x0)
    # Total variation is a mean over pairs, in nats of the mean texel that is seen.
    seen, pairs = int(posterior.observed.sum()), max(int(dr.width(around.pairs[0])), 1)
    strength = options.tv * np.sqrt(texels.count) * seen / pairs / (1 + HOLD)
    smoother = Smoother.of(
        1 / deviation**2, x0, around.around, strength, max(options.tv_epsilon, SUREST)
    )
    return TextureField(
        texels=texels, textures=textures, names=tuple(names), own=own, deviation=deviation,
        common=_common(posterior), correlations=Correlations(posterior, values),
        scale=np.asarray(posterior.common), smoother=smoother,
    )  # fmt: skip


def _common(posterior: CalibratedPosterior) -> np.ndarray:
    """Return the part of every variance that neighbourhoods have in common, (N, T)."""
    parts = np.concatenate([
        np.full(CHANNELS[name], COMMON_MIXED if name in MIXED else COMMON) for name in NAMES
    ])  # fmt: skip
    return np.where(posterior.observed, parts[:, None], 1.0).astype(np.float32)


def _own(posterior: CalibratedPosterior, x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return means and standard deviations of texels by themselves, (N, T) each; of those unseen,
    x0 and the prior's."""
    means, sds = (np.concatenate(list(table.values())) for table in moments(posterior))
    seen = posterior.observed
    deviation = np.maximum(np.where(seen, sds, prior_sds(posterior)[:, None]), SUREST)
    return np.where(seen, means, x0), deviation
