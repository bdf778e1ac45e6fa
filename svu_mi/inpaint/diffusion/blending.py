"""Blended diffusion: a model invents what is uncertain, between what is certain (Sec. 5.3).

A latent z starts as noise, and steps through the times t_1 > t_2 > ... of a schedule. At first,
what is certain (mask M, latent x of the known map) is put back after every step, with the noise
that belongs to that time; the last steps are the model's alone, so that no seam is left:

    z_i = step(z_{i-1}, e(z_{i-1}, t_i), t_i)                          every step
    z_i = M n(x, t_{i+1}) + (1 - M) z_i,   n(x, t) = a_t x + s_t e     but for the last ones

with a_t^2 + s_t^2 = 1, and e the noise that z started as [Avrahami et al. 2023, Blended Latent
Diffusion]. After the last time of all there is no noise: n is x itself. A model that would leave
what is certain as it is does so in the last steps, too, because the noise is the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol


class Schedule(Protocol):
    """The times of a diffusion, and what happens between them."""

    @property
    def times(self) -> Sequence[Any]:
        """The times, from noise to none."""

    def step(self, latent: Any, predicted: Any, time: Any) -> Any:
        """Return a latent at the time after one, given what the model predicts at it."""

    def noised(self, clean: Any, noise: Any, time: Any) -> Any:
        """Return a clean latent as it is at a time, n(x, t)."""


def blend(
    predict: Callable[[Any, Any], Any], schedule: Schedule, known: Any, certain: Any, noise: Any,
    free: int,
) -> Any:  # fmt: skip
    """Return the latent that a model makes of noise, between what is certain.

    Arrays and tensors of any library will do.

    Args:
        predict: ``predict(latent, time)``, the model.
        schedule: its times.
        known: x, latent of the map as far as it is known.
        certain: M, 1 where it is and 0 elsewhere; of a shape that goes with ``known``.
        noise: what to start from, of the shape of ``known``.
        free: steps at the end in which nothing is put back; 0 keeps what is certain exactly.
    """
    latent, times = noise, list(schedule.times)
    for number, time in enumerate(times, 1):
        latent = schedule.step(latent, predict(latent, time), time)
        if number <= len(times) - free:
            last = number == len(times)
            there = known if last else schedule.noised(known, noise, times[number])
            latent = certain * there + (1 - certain) * latent
    return latent
