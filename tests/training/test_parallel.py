"""A trial in several processes is the trial that one process would run; it ends as a whole, and leaves nothing."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

import pytest
import torch
from fault_campaign.processes import stat_of
from processes import Launcher, wait_until

from msk_ray.config import Config, parse_config
from msk_ray.errors import ConfigError, DeviceError, Failure, RankLost, SimulationError
from msk_ray.group import Group, PeerLost
from msk_ray.training import ParallelTrainer, Trainer, make_trainer, parallel, read_checkpoint
from msk_ray.training.parallel import _Answer, _Failure, _Rank

pytestmark = pytest.mark.long

SETTINGS: dict[str, Any] = {
    "env": {"name": "privileged:Commanded", "nworld": 8, "episode_length": 10},
    "physics": {"randomize": {"dof_damping": {"low": 0.5, "high": 2.0, "mode": "value"}}},
    "shac": {
        "horizon": {"kind": "adaptive", "start": 6, "shortest": 4, "longest": 12, "target": 5.0},
        "critic_iterations": 2,
        "critic_batches": 2,
        "normalize_return": True,
        "state_grad_clip": 10.0,
        "entropy": {"target": -0.5},
        "actor_value": "mean",
        "critic_tolerance": 1e-6,
    },
    "actor": {"hidden": [16], "state_std": True},
    "critic": {"hidden": [16], "count": 2},
    "evaluation": {"interval": 2, "nworld": 2, "steps": 4},
    "trial": {"epochs": 6},
    "execution": {"checkpoint_interval": 2, "loggers": []},
}
ROUNDING = {"rel": 1e-4, "abs": 1e-5}
NOISE = ("seconds", "env_steps_per_s", "time/", "physics/solver_residual", "hash/")
"""How the names of figures begin that are times, or that rounding changes altogether."""


def config_of(gpus: int) -> Config:
    return parse_config({**SETTINGS, "execution": {**SETTINGS["execution"], "gpus": gpus}})


def comparable(row: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in row.items() if not name.startswith(NOISE)}


@dataclass(frozen=True)
class Recorded:
    """What two processes did: four epochs, two of them again from the checkpoint between, and one after a kill."""

    folder: Path
    rows: list[dict[str, float]]
    again: list[dict[str, float]]
    pids: list[int]
    error: Exception


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """One start for all tests: each process imports for seconds."""
    folder = tmp_path_factory.mktemp("two")
    trainer = make_trainer(config_of(2), folder, "cpu")
    assert isinstance(trainer, ParallelTrainer)
    rows = [trainer.run_epoch() for _ in range(4)]
    trainer.restore(folder / "checkpoints" / "epoch_000002.pt")
    again = [trainer.run_epoch() for _ in range(2)]
    pids = [rank.process.pid for rank in trainer._ranks]
    os.kill(pids[1], signal.SIGKILL)
    with pytest.raises(RankLost) as caught:
        trainer.run_epoch()
    trainer.close()
    return Recorded(folder, rows, again, pids, caught.value)


def test_two_processes_learn_what_one_learns(two: Recorded, tmp_path: Path) -> None:
    alone = Trainer(config_of(1), tmp_path, "cpu")
    for row in two.rows:
        assert comparable(row) == pytest.approx(comparable(alone.run_epoch()), **ROUNDING)
    alone.close()
    ours, theirs = (read_checkpoint(folder / "checkpoints" / "epoch_000004.pt") for folder in (two.folder, tmp_path))
    for part in ("modules", "env_state", "randomizer", "discounted", "episodes", "actor_optimizer"):
        torch.testing.assert_close(ours["algorithm"][part], theirs["algorithm"][part], rtol=1e-4, atol=1e-5)
    assert ours["env_steps"] == theirs["env_steps"]


def test_two_processes_that_are_resumed_go_on_exactly(two: Recorded) -> None:
    assert [comparable(row) for row in two.again] == [comparable(row) for row in two.rows[2:]]


def test_one_process_goes_on_where_two_stopped(two: Recorded, tmp_path: Path) -> None:
    alone = Trainer(config_of(1), tmp_path, "cpu")
    with pytest.warns(UserWarning, match=r"epoch_000002\.pt was written with execution\.gpus 2, now 1"):
        alone.restore(two.folder / "checkpoints" / "epoch_000002.pt")
    row = comparable(alone.run_epoch())
    alone.close()
    assert row == pytest.approx(comparable(two.rows[2]), **ROUNDING)


def test_a_killed_process_ends_the_trial_with_its_name_and_nothing_stays(two: Recorded) -> None:
    assert f"process 1 of the trial (pid {two.pids[1]}) was ended by SIGKILL" in str(two.error)
    assert two.error.exit_code == 75
    assert not any(map(stat_of, two.pids))


def test_a_process_does_not_outlive_the_one_that_started_it(launcher: Launcher) -> None:
    child = (
        "import os, sys, time\n"
        "from msk_ray.rank import end_with_parent\n"
        "end_with_parent(int(sys.argv[1]))\n"
        "print(os.getpid(), flush=True)\n"
        "time.sleep(3600)"
    )
    start = f"import os, subprocess, sys\nsubprocess.Popen([sys.executable, '-c', {child!r}, str(os.getpid())]).wait()"
    parent = launcher.start([sys.executable, "-c", start], stdout=subprocess.PIPE)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    wait_until(lambda: not stat_of(pid))


class Astray(Group):
    """Two processes of which the other has changed one module by a bit."""

    size = 2

    def __init__(self, changed: str) -> None:
        self._changed = changed

    def collect(self, value: Any) -> list[Any]:
        return [value, {**value, self._changed: "0x0.0p+0"}] if isinstance(value, dict) else [value, value]


def test_processes_whose_networks_differ_are_not_saved(tmp_path: Path) -> None:
    trainer = Trainer(config_of(1), tmp_path, "cpu")
    trainer.env.group = Astray("critic.members.1.0.weight")
    with pytest.raises(RuntimeError, match=r"^critic\.members\.1\.0\.weight of process 1 .* not averaged"):
        trainer.algorithm.state_dict()
    trainer.close()


class Speaker:
    """One of the processes, made up: a pipe that the test speaks into."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.connection, self.other = Pipe()
        self.ended = False

    receive = _Rank.receive

    def send(self, message: Any) -> None:
        pass

    def exit_text(self) -> str:
        return f"process {self.number} is dead"

    def end(self) -> None:
        self.ended = True


@pytest.fixture
def speakers(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Speaker]]:
    monkeypatch.setattr(parallel, "_PATIENCE_S", 0.05)
    monkeypatch.setattr(parallel, "_SCORING_S", 0.05)
    made = [Speaker(number) for number in range(3)]
    yield made
    for speaker in made:
        speaker.connection.close()
        speaker.other.close()


def report(speakers: list[Speaker], said: dict[int, Exception | None]) -> None:
    """Processes send their errors, or die where there is none, in this order."""
    for number, error in said.items():
        if error is None:
            speakers[number].other.close()
        else:
            speakers[number].other.send(_Failure(error))


def trainer_of(speakers: list[Speaker], monkeypatch: pytest.MonkeyPatch, folder: Path) -> ParallelTrainer:
    """A trainer whose processes are made up, after its start."""
    waiting = iter(speakers)
    monkeypatch.setattr(parallel, "_Rank", lambda number: next(waiting))
    speakers[0].other.send(_Answer(None, 0, 0.0))
    config = parse_config({**SETTINGS, "env": {"name": "cartpole", "nworld": 6}, "execution": {"gpus": 3}})
    return ParallelTrainer(config, folder, "cpu")


OVERFLOW = SimulationError("contacts were lost: raise execution.nconmax", Failure.DIVERGED)
LOST = PeerLost("a collective operation failed")


@pytest.mark.parametrize(
    ("said", "kind", "message"),
    [
        ({2: OVERFLOW}, SimulationError, "^process 2 of the trial: contacts were lost: raise execution.nconmax$"),
        ({0: LOST, 1: LOST, 2: OVERFLOW}, SimulationError, "^process 2 of the trial: contacts were lost"),
        ({1: OVERFLOW, 0: OVERFLOW}, SimulationError, "^contacts were lost"),
        ({0: LOST, 1: None, 2: LOST}, RankLost, "^process 1 is dead"),
        ({0: LOST, 2: KeyError("a bug")}, KeyError, "a bug"),
        ({0: LOST}, PeerLost, "a collective operation failed"),
    ],
)
def test_the_reason_is_what_failed_first_and_not_what_follows_from_it(
    said: dict[int, Exception | None],
    kind: type[Exception],
    message: str,
    speakers: list[Speaker],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """Those who say nothing wait for the others, inside a GPU where no exception reaches them."""
    trainer = trainer_of(speakers, monkeypatch, tmp_path)
    report(speakers, said)
    with pytest.raises(kind, match=message) as caught:
        trainer.run_epoch()
    if isinstance(caught.value, SimulationError):
        assert caught.value.failure is Failure.DIVERGED
    assert all(speaker.ended for speaker in speakers)
    with pytest.raises(RankLost, match="have ended"):
        trainer.save()
    trainer.close()


@pytest.mark.parametrize("said", [{0: OVERFLOW}, {1: OVERFLOW, 0: OVERFLOW}, {1: None, 0: LOST, 2: LOST}])
def test_nobody_is_waited_for_who_could_say_nothing_more(
    said: dict[int, Exception | None], speakers: list[Speaker], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for patience in ("_PATIENCE_S", "_SCORING_S"):
        monkeypatch.setattr(parallel, patience, 3600.0)
    trainer = trainer_of(speakers, monkeypatch, tmp_path)
    report(speakers, said)
    with pytest.raises(RankLost if None in said.values() else SimulationError):
        trainer.run_epoch()


def test_an_error_that_cannot_be_sent_is_said_in_words() -> None:
    class Local(Exception):
        pass

    ours, theirs = Pipe()
    ours.send(_Failure(parallel._portable(Local("what it said"))))
    found = theirs.recv().error
    assert (type(found), str(found)) == (RuntimeError, "Local: what it said")
    for end in (ours, theirs):
        assert isinstance(end, Connection)
        end.close()


@pytest.mark.parametrize(
    ("section", "changes", "message"),
    [
        ("algorithm", {"name": "ppo"}, r"execution\.gpus 2: ppo trains in one process; write execution\.gpus: 1, or"),
        ("env", {"name": "cartpole", "nworld": 7}, r"execution\.gpus 2 must divide env\.nworld 7: write 6"),
        (
            "shac",
            {"horizon": 1, "critic_batches": 8},
            r"critic_batches 8 × execution\.gpus 2 must divide shac",
        ),
    ],
)
def test_what_several_processes_cannot_do_is_refused(section: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_config({**SETTINGS, section: changes, "execution": {"gpus": 2}})


def test_a_trial_of_several_gpus_needs_them_and_whoever_starts_its_processes(tmp_path: Path) -> None:
    many = parse_config({"env": {"name": "cartpole", "nworld": 64}, "execution": {"gpus": 64}})
    with pytest.raises(DeviceError, match=r"execution\.gpus 64, from cuda:1 on: torch sees \d+ CUDA device"):
        make_trainer(many, tmp_path, "cuda:1")
    with pytest.raises(ConfigError, match=r"start this trial with msk_ray\.train"):
        Trainer(config_of(2), tmp_path, "cpu")
    assert not list(tmp_path.iterdir())
