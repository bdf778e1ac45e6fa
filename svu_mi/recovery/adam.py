"""Gradient descent on textures: Adam, bounds, a falling rate, and an end.

An *objective* is any function ``objective(textures, step)`` of a dictionary of tensors that
returns one differentiable Float, and depends on nothing else: then a run that was interrupted
after a step goes on from there as if nothing had happened.

    descent = descend(lambda t, step: dr.mean(dr.square(t["roughness"] - 0.3), axis=None),
                      {"roughness": start}, DescentOptions(steps=100))
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from svu_mi.core.arrays import to_drjit
from svu_mi.core.interrupts import between_steps
from svu_mi.core.progress import Stage
from svu_mi.errors import SvuError
from svu_mi.recovery.checkpoint import Checkpoint, DescentState

if TYPE_CHECKING:
    from svu_mi.recovery.recovery_options import DescentOptions

Objective = Callable[[dict[str, Any], int], Any]
READ_EVERY = 10  # steps between two looks at the losses, each of which waits for the device


@dataclass(frozen=True, kw_only=True)
class Descent:
    """Where a descent ended.

    Attributes:
        values: the parameters, by name; tensors of the shapes they started with.
        losses: (N,) float32, before each step.
        steps: N, the number of steps that were taken.
        stopped: ``finished``: all steps; ``converged``: the loss fell no further.
    """

    values: dict[str, Any]
    losses: np.ndarray
    steps: int
    stopped: str


def descend(
    objective: Objective,
    start: Mapping[str, Any],
    options: DescentOptions,
    *,
    checkpoint: Checkpoint | None = None,
    progress: Stage | None = None,
) -> Descent:
    """Minimise an objective by Adam with projection onto bounds.

    The rate falls geometrically from ``learning_rate`` to ``final_rate`` times that.

    Args:
        objective: ``objective(textures, step)``; its loss is read every few steps only.
        start: TensorXf by name, the parameters that the objective is a function of; values
            outside the bounds are clipped.
        options: how to descend.
        checkpoint: where to save states, and perhaps to go on from. A ``KeyboardInterrupt``
            saves the last whole step before it is raised again.
        progress: a stage that shows steps, loss, rate and time left.
    """
    run = _DescentRun(objective, start, options)
    if checkpoint is not None and checkpoint.resume:
        run.resume(checkpoint)
    try:
        with between_steps() as answer:
            while run.step < options.steps and not run.has_converged():
                run.advance()
                if run.step % READ_EVERY == 0 or run.step == options.steps or run.ends_window():
                    run.read()
                    if progress is not None:
                        run.show(progress)
                    if checkpoint is not None and checkpoint.due:
                        checkpoint.save(run.state())
                answer()
    except KeyboardInterrupt:
        if checkpoint is not None:
            checkpoint.save(run.state())
        raise
    if checkpoint is not None:
        checkpoint.save(run.state())
    return Descent(
        values=run.values(), losses=np.array(run.losses, np.float32), steps=run.step,
        stopped="finished" if run.step == options.steps else "converged",
    )  # fmt: skip


def rate(options: DescentOptions, step: int) -> float:
    """Return the learning rate of a step: geometric from the first to the last."""
    part = step / max(options.steps - 1, 1)
    return options.learning_rate * options.final_rate**part


class _DescentRun:
    """A descent under way.

    ``step`` and what belongs to it change together at the end of a step, so that an interrupt in
    the middle of one finds the step before it.
    """

    def __init__(
        self, objective: Objective, start: Mapping[str, Any], options: DescentOptions
    ) -> None:
        self._objective, self._options = objective, options
        self._optimizer = Adam(
            lr=options.learning_rate, beta_1=options.beta_1, beta_2=options.beta_2
        )
        for name, tensor in start.items():
            self._optimizer[name] = self._project(mi.TensorXf(tensor))
        self.losses: list[float] = []  # those that were read
        self.step, self._state = 0, dict(self._optimizer.state)
        self._unread: tuple[tuple[Any, Any], ...] = ()  # losses, and whether gradients are broken
        self._clock: tuple[int, float] | None = None

    def advance(self) -> None:
        """Take one step; nothing waits for the device."""
        step, optimizer = self.step, self._optimizer
        loss = self._objective({name: optimizer[name] for name in optimizer}, step)
        dr.backward(loss)
        broken = dr.opaque(mi.UInt32, 0)
        for value in optimizer.values():
            gradient = value.grad.array
            # Adam would carry one bad gradient along for good, and hide where it began.
            dr.scatter(broken, mi.UInt32(1), mi.UInt32(0), ~dr.isfinite(gradient))
        # A number, not an array: Adam multiplies an array in place, and makes it opaque itself.
        now = rate(self._options, step)
        optimizer.set_learning_rate({n: now * self._options.scales.get(n, 1.0) for n in optimizer})
        optimizer.step(eval=False)
        for name in optimizer:
            optimizer[name] = self._project(optimizer[name])
        seen = dr.detach(loss)
        dr.eval(seen, broken, optimizer.state)
        unread = (*self._unread, (seen, broken))
        self.step, self._state, self._unread = step + 1, dict(optimizer.state), unread

    def read(self) -> None:
        """Wait for the device; refuse losses and gradients that are NaN or infinite."""
        first = self.step - len(self._unread)
        losses = []
        for step, (loss, broken) in enumerate(self._unread, first):
            losses.append(float(np.array(loss).ravel()[0]))
            if broken[0] or not np.isfinite(losses[-1]):
                what = "a gradient" if np.isfinite(losses[-1]) else "the loss"
                raise SvuError(
                    f"Descent: {what} of step {step} is NaN or infinite; look for NaN in the "
                    "photographs and for divisions by zero, or lower the learning rate."
                )
        self.losses[first:], self._unread = losses, ()

    def show(self, stage: Stage) -> None:
        """Show steps, loss, rate, and time left: from the first look on, before which kernels are
        compiled."""
        total, now = self._options.steps, time.monotonic()
        stage.update(self.step, total)
        text = f"loss {self.losses[-1]:.4g}, rate {rate(self._options, self.step - 1):.2g}"
        self._clock = first, since = self._clock or (self.step, now)
        if self.step > first:
            text += f", {(now - since) / (self.step - first) * (total - self.step):.0f} s left"
        stage.state(text)

    def ends_window(self) -> bool:
        """Return whether it is time to ask whether the descent has converged."""
        return self._options.tolerance > 0 and self.step % self._options.window == 0

    def has_converged(self) -> bool:
        """Return whether the mean loss of a window fell by less than ``tolerance`` of itself."""
        window = self._options.window
        if not self.ends_window() or self.step < 2 * window:
            return False
        before, now = np.reshape(self.losses[self.step - 2 * window : self.step], (2, window))
        return float(before.mean() - now.mean()) < self._options.tolerance * abs(before.mean())

    def values(self) -> dict[str, Any]:
        """Return the parameters, detached."""
        return {name: mi.TensorXf(dr.detach(entry[0])) for name, entry in self._state.items()}

    def state(self) -> DescentState:
        """Copy the last whole step."""
        self.read()
        entries = self._state.items()
        return DescentState(
            step=self.step,
            values={name: np.array(dr.detach(entry[0])) for name, entry in entries},
            first={name: np.array(entry[3][1]) for name, entry in entries},
            second={name: np.array(entry[3][2]) for name, entry in entries},
            losses=np.array(self.losses[: self.step], np.float32),
        )

    def resume(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint, if there is one."""
        optimizer = self._optimizer
        shapes = {name: tuple(value.shape) for name, value in optimizer.items()}
        state = checkpoint.load(shapes)
        if state is None:
            return
        for name, shape in shapes.items():
            kept = (state.values, state.first, state.second)
            last, *moments = (to_drjit(mi.Float, values[name].ravel()) for values in kept)
            optimizer[name] = mi.TensorXf(last, shape=shape)
            value, promoted, own_rate, (_, _, _, most) = optimizer.state[name]
            count = mi.UInt32(state.step)
            optimizer.state[name] = value, promoted, own_rate, (count, *moments, most)
        self.losses = state.losses.tolist()
        self.step, self._state = state.step, dict(optimizer.state)

    def _project(self, tensor: Any) -> Any:
        return dr.clip(dr.detach(tensor), self._options.low, self._options.high)
