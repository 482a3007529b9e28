"""Runs an epoch's work as recorded CUDA graphs."""

import gc
import traceback
import warnings
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from msk_ray.algorithms.base import Clock
from msk_ray.algorithms.shac import unrolling
from msk_ray.algorithms.shac.actor_update import ActorOutcome, ActorUpdate, EpochInputs, RolloutGraph, RolloutLoss
from msk_ray.algorithms.shac.runner import CriticWork, EagerRunner
from msk_ray.algorithms.shac.unrolling import unrolled_iterations
from msk_ray.envs import Env
from msk_ray.step.autograd.capture import Recording, fill
from msk_ray.step.autograd.stepper import Engine

UNRECORDED = "epochs run operation by operation, not as recorded graphs, and take two to three times as long"
_MOST_HORIZONS = 3
"""Largest number of recordings to keep, one per horizon: each keeps all its memory allocated."""
_TOO_MANY = f"the constraint solver needs more than {unrolling.MOST} iterations in some worlds"


@dataclass
class _Epoch:
    """A recorded epoch of one horizon."""

    inputs: EpochInputs
    roll_out: Recording[RolloutGraph]
    compute_loss: Recording[RolloutLoss]
    update_actor: Recording[ActorOutcome]


@dataclass
class _Fit:
    """A recorded fit of the critic."""

    inputs: tuple[Tensor, ...]
    work: Recording[Tensor]


@dataclass
class _Recordings:
    """Everything recorded with one engine of the simulation."""

    engine: Engine
    epochs: OrderedDict[int, _Epoch] = field(default_factory=OrderedDict)
    """Recorded epochs by horizon, most recently used last."""
    warm: set[int] = field(default_factory=set)
    """Horizons that have run eagerly, so that every kernel and buffer exists."""


class RecordedRunner(EagerRunner):
    """Replays recorded epochs, one recording per horizon, and fits the critic in parallel.

    A fit needs a rollout's targets, and must end before the next rollout's loss is computed: it runs in parallel with
    the backward pass and the next rollout. The target critic, which the backward pass reads, is updated after the fit.
    Results are the same as of running everything in sequence. `last_loss` is the loss of the previous fit.

    The first epoch of a horizon runs eagerly. Work that cannot be recorded, because an environment waits for the
    device, runs eagerly from then on; a warning says why and where. In a group, all processes record and replay the
    same work, because recordings contain collective operations. Two collectives must not run at the same time, so
    there the fit waits for the backward pass.

    Args:
        env: the worlds.
    """

    def __init__(self, actor: ActorUpdate, critic: CriticWork, env: Env[Any]) -> None:
        super().__init__(actor, critic, env)
        self._group = env.group
        self._kept = _Recordings(env.sim.engine)
        self._fits: dict[tuple[torch.Size, torch.Size], _Fit | None] = {}
        # With a higher priority, the actor's kernels start first, and the critic's fill what is left of the GPU. Only
        # a stream above the default priority is preferred.
        self._recording = torch.cuda.Stream(env.device, priority=-1)
        self._first = torch.cuda.Stream(env.device, priority=-1)
        self._side = torch.cuda.Stream(env.device)
        self._fitted = torch.cuda.Event()
        self._ready = torch.cuda.Event()
        self._target_behind = False
        """Whether the target critic has not been updated since the last fit was started."""
        self._fit_clock: Clock | None = None
        self._fit_s: float | None = None
        self._newest_loss: Tensor | None = None
        if env.overrides("begin_epoch") and not env.begin_epoch_in_place:
            self._refuse(
                f"{type(env).__qualname__}.begin_epoch may change numbers: keep them in tensors that it changes in "
                "place, and set begin_epoch_in_place"
            )

    @property
    def newest_loss(self) -> Tensor | None:
        return self.last_loss if self._newest_loss is None else self._newest_loss

    def resume(self, loss: Tensor | None) -> None:
        super().resume(loss)
        self._newest_loss = None

    def run(self, inputs: EpochInputs, critic_rate: float) -> ActorOutcome:
        epoch = self._epoch(inputs)
        self.recorded = epoch is not None
        if epoch is None:
            self.join()
            outcome = self._run_actor(inputs)
            self._start_fit(self._offer(outcome.critic_obs, outcome.targets), critic_rate)
            return outcome
        caller = torch.cuda.current_stream(self._device)
        self._first.wait_stream(caller)
        with torch.cuda.stream(self._first):
            outcome = self._replay(epoch, inputs, critic_rate)
        caller.wait_stream(self._first)
        return outcome

    def _replay(self, epoch: _Epoch, inputs: EpochInputs, critic_rate: float) -> ActorOutcome:
        self._clock = Clock(self._device)
        fill(epoch.inputs.tensors(), inputs.tensors())
        epoch.roll_out.replay()
        self._clock.mark("rollout")
        self.join()
        rollout_loss = epoch.compute_loss.replay()
        alone = self._group.size == 1
        offered = self._offer(*rollout_loss.for_critic) if alone else None
        outcome = epoch.update_actor.replay()
        self._clock.mark("backward")
        self._env.state = outcome.state
        # Only once the backward pass is running, because this makes the host wait for the previous fit.
        self._start_fit(self._offer(outcome.critic_obs, outcome.targets) if offered is None else offered, critic_rate)
        return outcome

    def _offer(self, obs: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
        """Copy what the next fit reads, and keep the loss of the previous fit, which has ended by now."""
        if self._newest_loss is not None:
            self.last_loss = self._newest_loss.clone()
        fit = self._fits.get((obs.shape, targets.shape))
        if fit is None:
            offered = obs.clone(), targets.clone()
        else:  # its last replay has ended
            offered = fit.inputs[0], fit.inputs[1]
            fill(offered, (obs, targets))
        self._ready.record(torch.cuda.current_stream(self._device))
        return offered

    def _start_fit(self, offered: tuple[Tensor, Tensor], rate: float) -> None:
        if self._fit_clock is not None:
            self._fit_s = self._fit_clock.seconds()["critic"]
        with torch.cuda.stream(self._side):
            self._side.wait_event(self._ready)
            for tensor in offered:
                tensor.record_stream(self._side)
            inputs = (*offered, self._critic.prepare_fit(offered[1].numel(), rate))
            fit = self._fit(inputs)
            self._fit_clock = Clock(self._device)
            if fit is None:
                self._newest_loss = self._critic.fit_critic(*inputs)
            else:
                fill(fit.inputs, inputs)
                self._newest_loss = fit.work.replay()
            self._fit_clock.mark("critic")
            self._fitted.record()
        self._target_behind = True

    def join(self) -> None:
        torch.cuda.current_stream(self._device).wait_event(self._fitted)
        if self._target_behind:
            self._critic.move_target()
            self._target_behind = False

    def seconds(self) -> dict[str, float]:
        return super().seconds() | ({} if self._fit_s is None else {"critic": self._fit_s})

    def adapt(self) -> None:
        batch = self._env.sim.batch
        if self.refusal is not None or not batch.stages.unrolls:
            return
        # Zeros if a batch with larger buffers has just replaced the epoch's.
        counts = batch.iterations.read()
        before = batch.unrolled_iterations
        # A resumed trial starts with an unrecorded epoch, and must adapt as if it were recorded.
        resumed = batch.ordered and before is not None
        if resumed and max(before or ()) > unrolling.MOST:
            self._refuse(_TOO_MANY)
            return
        now = unrolled_iterations(counts, before, batch.limits.iterations, followed=self.recorded or resumed)
        batch.unrolled_iterations = now
        # `recorded` is the same in all processes.
        if self.recorded and self._group.any(now != before):
            self._kept.epochs.clear()
        if self._group.any(max(now) > unrolling.MOST):
            self._refuse(_TOO_MANY)

    def _attempt(self, record: Callable[[], _Epoch]) -> _Epoch | None:
        epoch, why = None, ""
        try:
            epoch = record()
        except RuntimeError as error:
            first = _first(error)
            why = (
                f"{_place(first)} cannot be recorded ({str(first).splitlines()[0]}): make constants in `prepare`, and "
                "leave out .item(), .cpu() and conditions on tensors"
            )
        every = self._group.collect(why)
        if not any(every):
            return epoch
        self._refuse(next(filter(None, every)))
        # The failed recording is part of reference cycles; freed during a later one, it would spoil that.
        gc.collect()
        torch.cuda.empty_cache()
        return None

    def _refuse(self, why: str) -> None:
        self.refusal = why
        self._kept.epochs.clear()
        warnings.warn(f"{UNRECORDED}: {why}", stacklevel=2)

    def _epoch(self, inputs: EpochInputs) -> _Epoch | None:
        """The recorded epoch of this horizon; None if it must run eagerly."""
        if self.refusal is not None:
            return None
        engine, horizon = self._env.sim.engine, len(inputs.noise)
        if self._group.any(self._kept.engine is not engine):
            self._kept = _Recordings(engine)  # recordings use the buffers of the engine they were made with
        kept = self._kept
        if horizon in kept.epochs:
            kept.epochs.move_to_end(horizon)
            return kept.epochs[horizon]
        if horizon not in kept.warm:
            kept.warm.add(horizon)
            return None
        while len(kept.epochs) >= _MOST_HORIZONS:
            kept.epochs.popitem(last=False)
        epoch = self._attempt(lambda: self._record_epoch(inputs))
        if epoch is not None:
            kept.epochs[horizon] = epoch
        return epoch

    def _record_epoch(self, inputs: EpochInputs) -> _Epoch:
        buffers = inputs.copies()
        before = self._env.state
        try:
            roll_out = Recording(lambda: self._actor.roll_out(buffers), self._recording)
            compute_loss = Recording(
                lambda: self._actor.compute_loss(roll_out.result), self._recording, pool=roll_out.pool
            )
            update_actor = Recording(
                lambda: self._actor.update_actor(roll_out.result, compute_loss.result),
                self._recording,
                pool=roll_out.pool,
            )
        finally:
            self._env.state = before
            self._env.starts.stock(None)  # the recording's resets are in its own memory
            self._env.release_graph()
        return _Epoch(buffers, roll_out, compute_loss, update_actor)

    def _fit(self, inputs: tuple[Tensor, ...]) -> _Fit | None:
        """The recorded fit of this size; None if it must run eagerly."""
        shapes = (inputs[0].shape, inputs[1].shape)  # the shape of the orders follows from them
        if shapes not in self._fits:
            self._fits[shapes] = None
            return None
        if self._fits[shapes] is None:
            recorded = [known for known, fit in self._fits.items() if fit is not None]
            for oldest in recorded[: len(recorded) + 1 - _MOST_HORIZONS]:
                del self._fits[oldest]
            buffers = tuple(t.clone() for t in inputs)
            work = Recording(lambda: self._critic.fit_critic(*buffers), self._side)
            self._fits[shapes] = _Fit(buffers, work)
        return self._fits[shapes]


def _first(error: BaseException) -> BaseException:
    """The first error of a failed capture: it invalidates the capture, whose end raises another error."""
    while error.__context__ is not None:
        error = error.__context__
    return error


def _place(error: BaseException) -> str:
    """File and line where recording failed: the innermost frame outside torch and Warp."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if not {"torch", "warp", "mujoco_warp"} & set(Path(f.filename).parts)]
    frame = (own or frames)[-1]
    return f"{Path(frame.filename).name}:{frame.lineno}"
