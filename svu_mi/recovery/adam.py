"""Gradient descent on textures: Adam with bounds and early stopping.

An *objective* is a function ``objective(textures, step)`` that takes a dictionary of tensors and
returns one differentiable Float. It must depend on these arguments only, so that a resumed run
gives the same result as an uninterrupted one.

    descent = descend(lambda t, step: dr.mean(dr.square(t["roughness"] - 0.3), axis=None),
                      {"roughness": start}, DescentOptions(steps=100))
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from svu_mi.core.arrays import to_drjit
from svu_mi.core.interrupts import between_steps
from svu_mi.core.progress import Stage
from svu_mi.errors import SvuError
from svu_mi.recovery.checkpoint import Checkpoint, DescentState
from svu_mi.recovery.recovery_options import DescentOptions

Objective = Callable[[dict[str, Any], int], Any]
READ_EVERY = 10  # steps between reads of the losses; each read waits for the device


@dataclass(frozen=True, kw_only=True)
class Descent:
    """Result of a gradient descent.

    Attributes:
        values: Final parameters: TensorXf by name, in their initial shapes.
        losses: (N,) float32, loss before each step.
        steps: Number of steps taken, N.
        stopped: ``finished`` after all steps, or ``converged``.
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
    """Minimise an objective with Adam and clip parameters to bounds after each step.

    Args:
        objective: Function ``objective(textures, step)``, see the module.
        start: Initial parameters, TensorXf by name; values outside the bounds are clipped.
        options: Number of steps, learning rates, bounds and stopping criterion.
        checkpoint: File for states; the descent resumes from it if ``checkpoint.resume``. A
            ``KeyboardInterrupt`` saves the last complete step and is raised again.
        progress: Display of steps, loss, rate and remaining time.

    Raises:
        SvuError: The loss or a gradient is NaN or infinite.
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
    """Return the learning rate of a step, which falls geometrically to ``final_rate``."""
    part = step / max(options.steps - 1, 1)
    return options.learning_rate * options.final_rate**part


class _DescentRun:
    """State of a running descent.

    ``step``, optimizer state and unread losses are assigned together at the end of a step. An
    interrupt during a step thus leaves the state of the previous one.
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
        self.losses: list[float] = []  # without ``_unread``
        self.step, self._state = 0, dict(self._optimizer.state)
        self._unread: tuple[tuple[Any, Any], ...] = ()  # losses and flags of invalid gradients
        self._clock: tuple[int, float] | None = None

    def advance(self) -> None:
        """Take one step without waiting for the device."""
        step, optimizer = self.step, self._optimizer
        loss = self._objective({name: optimizer[name] for name in optimizer}, step)
        dr.backward(loss)
        # Adam would keep a NaN in its means, so its first step could not be reported. A flag for
        # each gradient: Dr.Jit launches a kernel for each scatter to the same array.
        broken = [dr.zeros(mi.UInt32, 1) for _ in optimizer.values()]
        for flag, value in zip(broken, optimizer.values(), strict=True):
            dr.scatter(flag, mi.UInt32(1), mi.UInt32(0), ~dr.isfinite(value.grad.array))
        # A Python number: Adam would multiply an array in place; it makes numbers opaque itself.
        now = rate(self._options, step)
        optimizer.set_learning_rate({n: now * self._options.scales.get(n, 1.0) for n in optimizer})
        optimizer.step(eval=False)
        seen, projected = dr.detach(loss), {n: self._project(optimizer[n]) for n in optimizer}
        # At once: assignments would evaluate one by one.
        dr.eval(seen, broken, projected, [entry[3] for entry in optimizer.state.values()])
        for name, value in projected.items():
            optimizer[name] = value
        unread = (*self._unread, (seen, broken))
        self.step, self._state, self._unread = step + 1, dict(optimizer.state), unread

    def read(self) -> None:
        """Wait for the device and read losses; raise an error if one is not finite."""
        first = self.step - len(self._unread)
        losses = []
        for step, (loss, broken) in enumerate(self._unread, first):
            losses.append(float(np.array(loss).ravel()[0]))
            if any(flag[0] for flag in broken) or not np.isfinite(losses[-1]):
                what = "a gradient" if np.isfinite(losses[-1]) else "the loss"
                raise SvuError(
                    f"Descent: {what} of step {step} is NaN or infinite; check the photographs for "
                    "NaN and the objective for divisions by 0, or lower the learning rate."
                )
        self.losses[first:], self._unread = losses, ()

    def show(self, stage: Stage) -> None:
        """Display step, loss, rate and remaining time.

        The clock starts at the first display, because the steps before it compile kernels.
        """
        total, now = self._options.steps, time.monotonic()
        stage.update(self.step, total)
        text = f"loss {self.losses[-1]:.4g}, rate {rate(self._options, self.step - 1):.2g}"
        self._clock = first, since = self._clock or (self.step, now)
        if self.step > first:
            text += f", {(now - since) / (self.step - first) * (total - self.step):.0f} s left"
        stage.state(text)

    def ends_window(self) -> bool:
        """Return whether a window of the convergence test ends at this step."""
        return self._options.tolerance > 0 and self.step % self._options.window == 0

    def has_converged(self) -> bool:
        """Return whether the mean loss of a window decreased by less than ``tolerance``."""
        window = self._options.window
        if not self.ends_window() or self.step < 2 * window:
            return False
        before, now = np.reshape(self.losses[self.step - 2 * window : self.step], (2, window))
        return float(before.mean() - now.mean()) < self._options.tolerance * abs(before.mean())

    def values(self) -> dict[str, Any]:
        """Return the parameters as detached TensorXf."""
        return {name: mi.TensorXf(dr.detach(entry[0])) for name, entry in self._state.items()}

    def state(self) -> DescentState:
        """Return a NumPy copy of the last complete step."""
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
        """Load the state of a checkpoint, if its file exists."""
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
