"""A trial in several processes, one per GPU, plus a parent that starts them and relays calls.

The parent computes nothing. It relays calls to process 0, which runs the `Trainer`; the others follow process 0. If one
fails or dies, even while the others wait for it in a collective operation, the parent kills them all and raises the
first error. If the parent dies, they die too.
"""

import contextlib
import math
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import Any

import torch

from msk_ray.config import Config, parse_config
from msk_ray.errors import DeviceError, MskRayError, RankLost, SimulationError
from msk_ray.group import PeerLost, ProcessGroup
from msk_ray.signals import NUMBERS
from msk_ray.step import use_device
from msk_ray.training.learner import follow
from msk_ray.training.trainer import Trainer
from msk_ray.training.trial_folder import TrialFolder

_PATIENCE_S = 5.0
"""How long to wait for the others' errors once one process has died [s]."""
_SCORING_S = 60.0
"""The same after a simulation error [s]: process 0, which usually fails too, first scores the waiting policies."""
_END_S = 60.0
"""How long processes may take to exit after their work is done [s]."""


def make_trainer(config: Config, logdir: Path, device: str, together: int = 1) -> "Trainer | ParallelTrainer":
    """A trial's trainer: in this process, or for `execution.gpus` above 1 in that many others.

    Args:
        config: every setting.
        logdir: folder of the trial.
        device: cpu or cuda:N, the first one if there are several.
        together: number of policies to score at the same time, as for `Trainer`.

    Raises:
        MskRayError: as their messages say.
    """
    return (Trainer if config.execution.gpus == 1 else ParallelTrainer)(config, logdir, device, together)


@dataclass(frozen=True)
class _Setup:
    """First message to a process."""

    rank: int
    config: Mapping[str, Any]
    """Plain data: classes of settings that are made while a module is imported cannot be sent."""
    logdir: Path
    device: str
    together: int
    meeting: Path


@dataclass(frozen=True)
class _Call:
    """A call of a method of process 0's trainer."""

    method: str
    arguments: tuple[Any, ...] = ()


@dataclass(frozen=True)
class _Answer:
    """The result of a call, and the trainer's state after it."""

    result: Any
    epoch: int
    best_score: float


@dataclass(frozen=True)
class _Failure:
    """The error that a process ends with."""

    error: Exception


class ParallelTrainer(TrialFolder):
    """A `Trainer` in `execution.gpus` processes, each with its GPU and an equal part of the worlds.

    Every error ends all of them; the trial continues from its newest checkpoint in another trainer. Call `close` at the
    end, from the thread that created this.

    Attributes:
        config: the trial's config.
        logdir: its folder.
        epoch: number of epochs done.
        together: number of policies that are scored at the same time.

    Raises:
        RankLost: from every method, if one of the processes has died.
        MskRayError: as `Trainer`; the message names the process if it was not process 0.
    """

    def __init__(self, config: Config, logdir: Path, device: str, together: int = 1) -> None:
        super().__init__(config, logdir)
        self._best_score = -math.inf
        devices = _devices(device, config.execution.gpus)
        self._scratch = tempfile.TemporaryDirectory(prefix="msk_ray_")
        self._ranks: list[_Rank] = []
        meeting = Path(self._scratch.name) / "meeting"
        try:
            for number in range(len(devices)):
                self._ranks.append(_Rank(number))
            for rank, own in zip(self._ranks, devices, strict=True):
                rank.send(_Setup(rank.number, config.as_dict(), logdir, own, together, meeting))
            self.together: int = self._await()
        except BaseException:
            self._end()
            raise

    @property
    def best_score(self) -> float:
        """Highest evaluation score of the trained policy so far, -inf before the first, which is that of `best.pt`."""
        return self._best_score

    @best_score.setter
    def best_score(self, score: float) -> None:
        self._call("__setattr__", "best_score", score)

    def run_epoch(self) -> dict[str, float]:
        """As `Trainer.run_epoch`."""
        row: dict[str, float] = self._call("run_epoch")
        return row

    def score_waiting(self) -> None:
        """As `Trainer.score_waiting`."""
        self._call("score_waiting")

    def save(self) -> Path:
        """As `Trainer.save`."""
        path: Path = self._call("save")
        return path

    def discard_checkpoint(self) -> None:
        """As `Trainer.discard_checkpoint`."""
        self._call("discard_checkpoint")

    def restore(self, path: Path, changed: Collection[str] = ()) -> None:
        """As `Trainer.restore`."""
        self._call("restore", path, frozenset(changed))

    def restore_latest(self) -> tuple[Path | None, list[str]]:
        """As `Trainer.restore_latest`."""
        reply: tuple[Path | None, list[str]] = self._call("restore_latest")
        return reply

    def solver(self) -> str:
        """As `Trainer.solver`."""
        reply: str = self._call("solver")
        return reply

    def remarks(self) -> list[str]:
        """As `Trainer.remarks`."""
        reply: list[str] = self._call("remarks")
        return reply

    def close(self) -> None:
        """Flush the logs and end the processes; nothing if they have ended."""
        if self._ranks:
            self._call("close")
            deadline = time.monotonic() + _END_S
            for rank in self._ranks:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    rank.process.wait(max(0.0, deadline - time.monotonic()))
            self._end()

    def _call(self, method: str, *arguments: Any) -> Any:
        if not self._ranks:
            raise RankLost("the processes of this trial have ended: continue it in another trainer")
        try:
            self._ranks[0].send(_Call(method, arguments))
            return self._await()
        except BaseException:
            self._end()
            raise

    def _await(self) -> Any:
        """The result of the call that process 0 was sent; raises if any process fails first."""
        silent = list(self._ranks)
        failures: dict[int, Exception | None] = {}
        deadline = math.inf
        while silent and time.monotonic() < deadline:
            left = None if math.isinf(deadline) else max(0.0, deadline - time.monotonic())
            ready = wait([rank.connection for rank in silent], left)
            for rank in [rank for rank in silent if rank.connection in ready]:
                report = rank.receive()
                if isinstance(report, _Answer) and not failures:
                    self.epoch, self._best_score = report.epoch, report.best_score
                    return report.result
                silent.remove(rank)
                if not isinstance(report, _Answer):
                    error = failures[rank.number] = None if report is None else report.error
                    deadline = min(deadline, time.monotonic() + _patience(rank.number, error))
        raise self._reason(failures)

    def _reason(self, failures: dict[int, Exception | None]) -> Exception:
        """Why the processes failed: the first error that is not a consequence of another process's death.

        Args:
            failures: errors by rank, in order of arrival; None for a process that died.
        """
        said = [(number, error) for number, error in sorted(failures.items()) if error is not None]
        for number, error in said:
            if isinstance(error, MskRayError):
                return _in_rank(error, number)
        for number in (number for number, error in failures.items() if error is None):
            return RankLost(f"{self._ranks[number].exit_text()}; a resumed trial continues from its last checkpoint")
        return next((error for _, error in said if not isinstance(error, PeerLost)), said[0][1])

    def _end(self) -> None:
        """Kill all processes and close their connections."""
        for rank in self._ranks:
            rank.end()
        self._ranks = []
        self._scratch.cleanup()


class _Rank:
    """One of the processes, seen from the parent.

    The process ignores signals that ask it to stop: the parent decides what to do.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self.connection, theirs = Pipe()
        # This interpreter's import path, so that classes named in the configuration are found there too.
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        environment = {"GLOO_SOCKET_IFNAME": "lo", **os.environ, "PYTHONPATH": path}
        command = [sys.executable, "-P", "-m", "msk_ray.rank", str(theirs.fileno()), str(os.getpid())]
        # A child inherits blocked signals.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, NUMBERS)
        try:
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, env=environment, pass_fds=[theirs.fileno()]
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()

    def send(self, message: "_Setup | _Call") -> None:
        """Send a message; ignored if the process has died, which `receive` reports."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send(message)

    def receive(self) -> "_Answer | _Failure | None":
        """The next message; None if the process has died."""
        try:
            message: _Answer | _Failure = self.connection.recv()
        except (EOFError, ConnectionResetError):
            return None
        return message

    def exit_text(self) -> str:
        """How the process ended, as text."""
        code = self.process.wait()
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return f"process {self.number} of the trial (pid {self.process.pid}) {how}"

    def end(self) -> None:
        """Kill the process if it is still running."""
        self.process.kill()
        self.process.wait()
        self.connection.close()


def serve(connection: Connection) -> None:
    """Main function of each process.

    Args:
        connection: to the process that started this one, which sends a `_Setup` first.
    """
    try:
        setup: _Setup = connection.recv()
        config = parse_config(setup.config)
        use_device(setup.device)
        group = ProcessGroup(setup.rank, config.execution.gpus, setup.device, setup.meeting)
        if setup.rank > 0:
            warnings.simplefilter("ignore")  # process 0 gives the same
            follow(config, setup.device, group)
        else:
            _lead(setup, config, group, connection)
    except Exception as error:
        error.add_note(f"In a process of the trial, {os.getpid()}:\n{traceback.format_exc()}")
        connection.send(_Failure(_portable(error)))


def _lead(setup: _Setup, config: Config, group: ProcessGroup, connection: Connection) -> None:
    """Run the trainer for the parent, until it is closed."""
    trainer = Trainer(config, setup.logdir, setup.device, setup.together, group)
    connection.send(_Answer(trainer.together, trainer.epoch, trainer.best_score))
    try:
        while (call := connection.recv()).method != "close":
            result = getattr(trainer, call.method)(*call.arguments)
            connection.send(_Answer(result, trainer.epoch, trainer.best_score))
    finally:
        trainer.close()
    connection.send(_Answer(None, trainer.epoch, trainer.best_score))
    group.send_order()


def _devices(first: str, count: int) -> list[str]:
    """The device of each process.

    Raises:
        DeviceError: there are fewer devices.
    """
    if not first.startswith("cuda"):
        return [first] * count
    try:
        start, there = torch.device(first).index or 0, torch.cuda.device_count()
    except RuntimeError:
        raise DeviceError(f"unknown device {first!r}: write cpu, cuda or cuda:0") from None
    if start + count > there:
        raise DeviceError(
            f"execution.gpus {count}, from {first} on: torch sees {there} CUDA device(s); lower execution.gpus, "
            "or write --device cpu"
        )
    return [f"cuda:{start + rank}" for rank in range(count)]


def _patience(number: int, error: Exception | None) -> float:
    """How long to wait for further errors after a process has failed [s]."""
    if number == 0 and isinstance(error, MskRayError):
        return 0.0  # this is the cause, whatever the others report
    return _SCORING_S if isinstance(error, SimulationError) else _PATIENCE_S


def _in_rank(error: MskRayError, number: int) -> MskRayError:
    """The same error; unless it comes from process 0, its message names the process."""
    if number > 0:
        message = f"process {number} of the trial: {error}"
        error.args = (message, *error.args[1:])
        if hasattr(error, "message"):
            error.message = message
    return error


def _portable(error: Exception) -> Exception:
    """The error, or one with the same text if it cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # any type: pickling may run foreign code
        copy = RuntimeError(f"{type(error).__name__}: {error}")
        for note in getattr(error, "__notes__", ()):
            copy.add_note(note)
        return copy
    return error
