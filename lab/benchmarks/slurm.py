"""Sweeps through cluster/slurm.sbatch on a real SLURM with two nodes, stopped in every way that SLURM has.

The nodes are namespaces of one Linux machine (needs root), each with a slurmd; slurmctld runs on the first. In every
scenario a CartPole sweep is submitted, stopped, and restarted by the queue or by hand until it ends. Then every trial
must have finished with every epoch present exactly once, and no job may leave a process or a token behind. SLURM's own
files are in a temporary folder; an existing SLURM of this machine is not touched.
"""

import argparse
import json
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from hosts import Host, check_possible, network
from record import RESULTS, markdown_table, publish

from msk_ray.config import dump_yaml
from msk_ray.experiment.manifest import Experiment, has_begun
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.outcomes import read_ending

TRIALS = 3
SPACE = {
    "question": "Does an experiment survive what SLURM does to jobs?",
    "base": "configs/cartpole.yaml",
    "overrides": {
        "env.nworld": 64,
        "evaluation.interval": 5,
        "evaluation.steps": 32,
        "trial.checkpoint_interval": 5,
    },
    "seeds": f"0-{TRIALS - 1}",
}
ADDRESSES = {"slurm-a": "10.214.78.1", "slurm-b": "10.214.78.2"}
"""Node names and addresses."""
NEEDED = ("slurmctld", "slurmd", "sbatch", "scontrol", "scancel", "srun", "munged")
LIMIT_S = 1500.0
"""Far longer than any single step takes on a busy machine."""
BEGUN = "job begins"
"""In the log each time that slurm.sbatch starts."""
CONF = """\
ClusterName=msk
SlurmctldHost=slurm-a({address})
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={scratch}/munge/socket
StateSaveLocation={scratch}/state
SlurmdSpoolDir={scratch}/%n/spool
SlurmctldPidFile={scratch}/slurmctld.pid
SlurmdPidFile={scratch}/%n/slurmd.pid
SlurmctldLogFile={scratch}/slurmctld.log
SlurmdLogFile={scratch}/%n/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
ReturnToService=2
SlurmdTimeout=30
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=5
{nodes}
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


@dataclass
class Slurm:
    """A SLURM of two nodes, and the jobs on it."""

    scratch: Path
    epochs: int
    """Of each trial."""
    nodes: list[Host] = field(default_factory=list)

    @property
    def first(self) -> Host:
        return self.nodes[0]

    def start_node(self, name: str) -> Host:
        environment = {
            "SLURM_CONF": str(self.scratch / "slurm.conf"),
            "MSK_RAY_TMP": str(self.scratch / "t"),
            "MSK_RAY_BIN": str(Path(sys.executable).parent),
            "MSK_RAY_START_LIMIT": str(int(LIMIT_S)),
        }
        host = Host(name, ADDRESSES[name], self.scratch / "t", self.scratch / name, environment)
        (host.disk / "spool").mkdir(exist_ok=True)
        if name == "slurm-a":
            host.start(["slurmctld", "-D", "-i"], self.scratch / "slurmctld.out")
        host.start(["slurmd", "-D"], self.scratch / f"{name}.out")
        return host

    def submit(self, name: str, requeue: bool) -> str:
        """Submit the sweep as an experiment of that name; the job's id."""
        options = ["--parsable", "--nodes=2", "--cpus-per-task=1", "--gpus-per-node=0", "--time=60"]
        sweep = ["--cpu", "--name", name, "--set", f"trial.epochs={self.epochs}"]
        return self.first.ask(
            [
                "sbatch",
                *options,
                f"--output={self.scratch}/%j.log",
                "cluster/slurm.sbatch",
                str(self.scratch / "space.yaml"),
                str(self.scratch / "runs"),
                *sweep,
            ],
            {"MSK_RAY_REQUEUE": "1" if requeue else "0"},
        ).strip()

    def job(self, job: str) -> dict[str, str]:
        """What scontrol says of it."""
        text = self.first.ask(["scontrol", "show", "job", job])
        return dict(word.split("=", 1) for word in text.split() if "=" in word)

    def log(self, job: str) -> str:
        path = self.scratch / f"{job}.log"
        return path.read_text(errors="replace") if path.exists() else ""

    def wait(self, what: str, condition: Callable[[], object], job: str) -> None:
        """Wait for it.

        Raises:
            RuntimeError: the job has ended, or the time is up.
        """
        deadline = time.monotonic() + LIMIT_S
        while not condition():
            state = self.job(job)
            over = state["JobState"] in ("COMPLETED", "FAILED", "CANCELLED", "TIMEOUT")
            if (over and not condition()) or time.monotonic() > deadline:
                raise RuntimeError(f"{what}: did not come; job {state}\n{self.log(job)[-4000:]}")
            if state["JobState"] == "PENDING" and state["Reason"] == "BeginTime":
                # SLURM lets two minutes pass before it starts a job again.
                self.first.ask(["scontrol", "update", f"JobId={job}", "StartTime=now"])
            time.sleep(0.5)

    def wait_for_state(self, job: str, *states: str) -> dict[str, str]:
        self.wait(f"state {' or '.join(states)}", lambda: self.job(job)["JobState"] in states, job)
        return self.job(job)

    def wait_for_restart(self, job: str, count: int) -> None:
        """Wait until it has been put back into the queue a number of times and runs again."""
        self.wait(
            f"restart {count}",
            lambda: (state := self.job(job))["Restarts"] == str(count) and state["JobState"] == "RUNNING",
            job,
        )

    def wait_for_log(self, job: str, restarts: int, condition: Callable[[str], bool]) -> None:
        """Wait until the job's output since its last restart fulfils a condition."""

        def said() -> bool:
            runs = self.log(job).split(BEGUN)
            return len(runs) == restarts + 2 and condition(runs[-1])

        self.wait("the moment", said, job)

    def running(self, name: str) -> dict[str, set[str]]:
        """Trials of an experiment at work that have written rows, by node."""
        found: dict[str, set[str]] = {node: set() for node in ADDRESSES}
        trials = self.scratch / "runs" / name / "trials"
        for folder in trials.iterdir() if trials.is_dir() else ():
            if (folder / "device.json").is_file() and read_ending(folder) is None and len(read_rows(folder)) > 5:
                found[json.loads((folder / "device.json").read_text())["host"]].add(folder.name)
        return found

    def wait_for_trials(self, job: str, name: str) -> None:
        self.wait("trials on both nodes", lambda: all(self.running(name).values()), job)

    def left_over(self, tokens: bool) -> list[str]:
        """Processes of jobs on the nodes, and tokens."""
        own = {"sleep", "slurmctld", "slurmd", "slurmscriptd", "ps"}
        found = [str(path) for path in self.scratch.glob("slurm-?/msk_ray-*/token")] if tokens else []
        for node in self.nodes:
            for line in node.ask(["ps", "-eo", "pid=,stat=,comm="]).splitlines():
                pid, state, name = line.split(maxsplit=2)
                if pid != "1" and not state.startswith("Z") and name not in own:
                    found.append(f"{node.name}: {name}")
        return found


Scenario = Callable[[Slurm, str], str]


def undisturbed(slurm: Slurm, name: str) -> str:
    """left alone"""
    job = slurm.submit(name, requeue=False)
    slurm.wait_for_trials(job, name)
    slurm.wait_for_state(job, "COMPLETED")
    return "COMPLETED"


def time_limit(slurm: Slurm, name: str) -> str:
    """out of time while trials run"""
    job = slurm.submit(name, requeue=True)
    slurm.wait_for_trials(job, name)
    # As if the limit had been so from the start: the warning is due 120 s before it.
    minutes, seconds = slurm.job(job)["RunTime"].split(":")[-2:]
    slurm.first.ask(["scontrol", "update", f"JobId={job}", f"TimeLimit={int(minutes) + 2 + (int(seconds) > 0)}"])
    slurm.wait_for_restart(job, 1)
    slurm.first.ask(["scontrol", "update", f"JobId={job}", "TimeLimit=60"])
    slurm.wait_for_state(job, "COMPLETED")
    return "75, requeued, COMPLETED"


def before_trials(slurm: Slurm, name: str) -> str:
    """USR1 to the script at its start, while nodes join, while Python loads, while kernels compile"""
    job = slurm.submit(name, requeue=True)
    moments: list[Callable[[str], bool]] = [
        lambda said: True,
        lambda said: "waiting for 2 node(s)" in said,
        lambda said: "2 of 2 node(s) have joined" in said,
        lambda said: (slurm.scratch / "runs" / name / "manifest.json").exists(),
    ]
    for count, moment in enumerate(moments):
        slurm.wait_for_restart(job, count)
        slurm.wait_for_log(job, count, moment)
        slurm.first.ask(["scancel", "--batch", "--signal=USR1", job])
        slurm.wait_for_restart(job, count + 1)
    slurm.wait_for_state(job, "COMPLETED")
    return f"{len(moments)} times 75, requeued, COMPLETED"


def cancelled(slurm: Slurm, name: str) -> str:
    """scancel while trials run; submitted again"""
    job = slurm.submit(name, requeue=True)
    slurm.wait_for_trials(job, name)
    slurm.first.ask(["scancel", job])
    slurm.wait_for_state(job, "CANCELLED")
    gone(slurm, tokens=False)
    if slurm.job(job)["Restarts"] != "0":
        raise RuntimeError("a cancelled job went back into the queue")
    slurm.wait_for_state(slurm.submit(name, requeue=False), "COMPLETED")
    return "CANCELLED; COMPLETED"


def asked_to_save(slurm: Slurm, name: str) -> str:
    """scancel --batch --signal=TERM while trials run; submitted again"""
    job = slurm.submit(name, requeue=True)
    slurm.wait_for_trials(job, name)
    slurm.first.ask(["scancel", "--batch", "--signal=TERM", job])
    slurm.wait("end", lambda: slurm.job(job)["ExitCode"] == "75:0", job)
    gone(slurm)
    if slurm.job(job)["Restarts"] != "0":
        raise RuntimeError("a job that was asked to stop went back into the queue")
    slurm.wait_for_state(slurm.submit(name, requeue=False), "COMPLETED")
    return "75; COMPLETED"


def node_lost(slurm: Slurm, name: str) -> str:
    """a node dies while trials run, and comes back"""
    job = slurm.submit(name, requeue=False)
    slurm.wait_for_trials(job, name)
    slurm.nodes[1].kill()
    slurm.wait("requeue by SLURM", lambda: slurm.job(job)["JobState"] in ("PENDING", "REQUEUED", "NODE_FAIL"), job)
    slurm.nodes[1] = slurm.start_node("slurm-b")
    slurm.wait_for_restart(job, 1)
    slurm.wait_for_state(job, "COMPLETED")
    return "requeued by SLURM, COMPLETED"


SCENARIOS: tuple[Scenario, ...] = (undisturbed, time_limit, before_trials, cancelled, asked_to_save, node_lost)


def gone(slurm: Slurm, tokens: bool = True) -> None:
    """Wait until nothing of any job is left.

    Args:
        tokens: whether that holds for tokens too; those of jobs that were killed go with the next job.

    Raises:
        RuntimeError: something stays.
    """
    deadline = time.monotonic() + LIMIT_S / 10
    while left := slurm.left_over(tokens):
        if time.monotonic() > deadline:
            raise RuntimeError(f"left over: {left}")
        time.sleep(0.5)


@contextmanager
def _slurm(scratch: Path, epochs: int) -> Iterator[Slurm]:
    munge = scratch / "munge"
    for folder in (munge, scratch / "state"):
        folder.mkdir()
    for folder in (scratch, munge):
        folder.chmod(0o755)
    key = munge / "key"
    key.touch(mode=0o600)
    key.write_bytes(secrets.token_bytes(128))
    nodes = "\n".join(f"NodeName={name} NodeAddr={address} CPUs=2" for name, address in ADDRESSES.items())
    (scratch / "slurm.conf").write_text(CONF.format(scratch=scratch, nodes=nodes, address=ADDRESSES["slurm-a"]))
    # slurmd asks for cgroups at its start even where nothing uses them, and a network namespace's /sys has none.
    (scratch / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n")
    files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "seed-file": "seed", "log-file": "log"}
    with (scratch / "munged.out").open("wb") as out:
        munged = subprocess.Popen(
            ["setpriv", "--pdeathsig", "KILL", "munged", "--foreground"]
            + [f"--{option}={munge / file}" for option, file in files.items()],
            stdout=out,
            stderr=out,
        )
    slurm = Slurm(scratch, epochs)
    try:
        while not (munge / "socket").exists():
            if munged.poll() is not None:
                sys.exit(f"munged: {(scratch / 'munged.out').read_text()}")
            time.sleep(0.05)
        with network(ADDRESSES):
            try:
                for name in ADDRESSES:
                    slurm.nodes.append(slurm.start_node(name))
                _wait_until_idle(slurm)
                yield slurm
            finally:
                for node in slurm.nodes:
                    node.kill()
    finally:
        munged.terminate()
        munged.wait()


def _wait_until_idle(slurm: Slurm) -> None:
    deadline = time.monotonic() + LIMIT_S / 10
    while True:
        try:
            if slurm.first.ask(["sinfo", "--noheader", "--format=%t %D"]).split() == ["idle", "2"]:
                return
        except subprocess.CalledProcessError:
            pass  # slurmctld is not up yet
        if time.monotonic() > deadline:
            logs = [path.read_text()[-2000:] for path in sorted(slurm.scratch.glob("**/*.log"))]
            sys.exit("the nodes did not come up:\n" + "\n".join(logs))
        time.sleep(0.5)


def _losses(experiment: Experiment, epochs: int) -> tuple[int, int, int]:
    """Trials that have not finished, rows missing, and rows that are there twice."""
    if not has_begun(experiment.path):
        return TRIALS, TRIALS * (epochs + 1), 0
    unfinished = missing = doubled = 0
    for trial in experiment.trials():
        path = experiment.trial_folder(trial.id)
        ending = read_ending(path)
        unfinished += ending is None or ending.outcome != "finished"
        there = [row["epoch"] for row in read_rows(path)]
        missing += epochs + 1 - len(set(there) & set(range(epochs + 1)))
        doubled += len(there) - len(set(there))
    return unfinished, missing, doubled


def main() -> int:
    """Run them; 1 if anything was lost."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    p.add_argument("--keep", action="store_true", help="keep experiments and logs")
    names = [scenario.__name__ for scenario in SCENARIOS]
    p.add_argument("--only", choices=names, nargs="+", default=names, help="these scenarios alone")
    p.add_argument("--epochs", type=int, default=200, help="of each trial, by default 200; fewer on a slow machine")
    args = p.parse_args()
    check_possible()
    missing_programs = [name for name in NEEDED if shutil.which(name) is None]
    if missing_programs:
        sys.exit(f"not here: {', '.join(missing_programs)} (apt-get install slurm-wlm munge)")
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    # Ray's sockets lie below, and their paths may have 107 bytes.
    scratch = Path(tempfile.mkdtemp(prefix="", dir="/tmp"))
    (scratch / "space.yaml").write_text(dump_yaml(SPACE))
    rows, failed = [], False
    with _slurm(scratch, args.epochs) as slurm:
        version = slurm.first.ask(["slurmctld", "-V"]).strip()
        for scenario in SCENARIOS:
            if scenario.__name__ not in args.only:
                continue
            what, started = (scenario.__doc__ or "").strip(), time.monotonic()
            print(f"{scenario.__name__}: {what}", flush=True)
            try:
                result = scenario(slurm, scenario.__name__)
                gone(slurm)
            except (RuntimeError, subprocess.CalledProcessError) as error:
                print(error, file=sys.stderr)
                result, failed = f"FAILED: {str(error).splitlines()[0][:80]}", True
                slurm.first.ask(["scancel", "--user=root"])
            losses = _losses(Experiment(scratch / "runs" / scenario.__name__), args.epochs)
            failed = failed or any(losses)
            seconds = time.monotonic() - started
            print(f"  {result}; unfinished, missing, doubled: {losses}; {seconds:.0f} s", flush=True)
            rows.append([what, result, *map(str, losses), f"{seconds:.0f} s"])
    header = ["scenario", "job", "trials unfinished", "rows missing", "rows doubled", "time"]
    title = f"{version}, two nodes, {TRIALS} CartPole trials of {args.epochs} epochs in each scenario"
    publish("slurm", title, "cpu", markdown_table(header, rows), args.results)
    if args.keep or failed:
        print(f"kept: {scratch}")
    else:
        shutil.rmtree(scratch)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
