"""The SLURM script run for real, with fakes for SLURM, Ray and Python that write down how they were called."""

import contextlib
import os
import signal
import stat
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

FAKES = {
    "scontrol": """
        echo "scontrol $*" >> "$LOG"
        if [ "$1" = show ]; then printf 'node1\\nnode2\\n'; fi""",
    "sleep": "exec /bin/sleep 0.02",
    "hostname": "echo '10.0.0.1 192.168.0.1'",
    # A step stays until it is told to go, as `ray start --block` does.
    "srun": """
        echo "srun $*" >> "$LOG"
        stat -c 'token %a' "$RAY_AUTH_TOKEN_PATH" >> "$LOG"
        echo "mode $RAY_AUTH_MODE, $(wc -c < "$RAY_AUTH_TOKEN_PATH") characters" >> "$LOG"
        echo "tmp $RAY_TMPDIR" >> "$LOG"
        if [ -n "$STEP_FAILS" ]; then exit 1; fi
        trap 'echo step ended >> "$LOG"; exit 0' TERM
        while true; do /bin/sleep 0.02; done""",
    "python": """
        echo "python $*" >> "$LOG"
        case "$*" in
        *msk_ray.tune.cluster*)
            if [ -n "$STEP_FAILS" ] || [ ! -e joined ]; then touch joined; exit 1; fi
            exit 0 ;;
        esac
        echo "tmp $RAY_TMPDIR" >> "$LOG"
        trap 'echo driver saved >> "$LOG"; exit 75' USR1
        trap 'echo driver told to go >> "$LOG"; exit 75' TERM
        echo driver up >> "$LOG"
        if [ -n "$DRIVER_EXITS" ]; then exit "$DRIVER_EXITS"; fi
        while true; do /bin/sleep 0.02; done""",
}


@pytest.fixture
def job(tmp_path: Path, root: Path) -> Iterator["Job"]:
    bin_folder = tmp_path / "bin"
    bin_folder.mkdir()
    for name, body in FAKES.items():
        (bin_folder / name).write_text(f"#!/bin/bash\n{body}\n")
        (bin_folder / name).chmod(0o755)
    project = tmp_path / "project"
    project.mkdir()
    (project / "cluster").symlink_to(root / "cluster")
    made = Job(tmp_path, root / "cluster" / "slurm.sbatch")
    yield made
    for process in made.started:
        with contextlib.suppress(ProcessLookupError):  # all of it has ended
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


class Job:
    """A submitted job."""

    def __init__(self, folder: Path, script: Path) -> None:
        self.folder, self.script, self.log = folder, script, folder / "log"
        self.started: list[subprocess.Popen[str]] = []
        self.environment = {
            "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
            "LOG": str(self.log),
            "SLURM_SUBMIT_DIR": str(folder / "project"),
            "SLURM_JOB_ID": "123456",
            "SLURM_JOB_NODELIST": "node[1-2]",
            "SLURM_CPUS_PER_TASK": "16",
            "MSK_RAY_BIN": str(folder / "bin"),
        }

    def start(self, *options: str, **environment: str) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            ["bash", str(self.script), "ant_lr", str(self.folder / "runs"), *options],
            env=self.environment | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self.started.append(process)
        return process

    def run(self, *options: str, **environment: str) -> tuple[int, str]:
        """Exit code and output."""
        process = self.start(*options, **environment)
        output, _ = process.communicate(timeout=30)
        return process.returncode, output

    def lines(self, beginning: str) -> list[str]:
        text = self.log.read_text() if self.log.exists() else ""
        return [line for line in text.splitlines() if line.startswith(beginning)]

    def wait_for(self, line: str) -> None:
        for _ in range(400):
            if self.lines(line):
                return
            time.sleep(0.05)
        raise AssertionError(f"no {line!r} in {self.log.read_text()}")

    def left_over(self) -> list[str]:
        """What the job left in the project's folder."""
        return sorted(path.name for path in (self.folder / "project").iterdir())


@pytest.mark.parametrize("code", [0, 1, 2, 130])
def test_the_drivers_exit_code_is_the_jobs(job: Job, code: int) -> None:
    assert job.run(DRIVER_EXITS=str(code))[0] == code
    assert job.left_over() == ["cluster", "joined"]  # no token


def test_head_workers_and_driver(job: Job) -> None:
    job.run("--seeds", "0-4", DRIVER_EXITS="0")
    head, worker = job.lines("srun")
    for line in (head, worker):
        assert "--nodes=1 --ntasks=1 --overlap" in line
        assert "ray start --block" in line
        assert "--num-cpus=16" in line
    if "--head" not in head:  # they start at the same time
        head, worker = worker, head
    assert "--nodelist=node1" in head
    assert "--head --node-ip-address=10.0.0.1 --port=33824" in head
    assert "--dashboard-host=127.0.0.1" in head
    assert "--nodelist=node2" in worker
    assert "--address=10.0.0.1:33824" in worker
    checks, (driver,) = job.lines("python -m msk_ray.tune.cluster"), job.lines("python -m msk_ray.tune --")
    assert (
        checks == ["python -m msk_ray.tune.cluster --address 10.0.0.1:33824 --nodes 2"] * 2
    )  # the second time all are
    storage = job.folder / "runs"
    expected = f"--space ant_lr --name ant_lr --storage {storage} --seeds 0-4 --address 10.0.0.1:33824"
    assert driver == f"python -m msk_ray.tune {expected}"


def test_the_token_is_for_its_owner_alone_and_goes_with_the_job(job: Job) -> None:
    process = job.start()
    job.wait_for("driver up")
    (token,) = (job.folder / "project").glob(".ray-token-*")
    assert stat.S_IMODE(token.stat().st_mode) == 0o600
    assert len(token.read_text()) == 64
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=30)
    assert not token.exists()
    assert set(job.lines("token")) == {"token 600"}
    assert set(job.lines("mode")) == {"mode token, 64 characters"}


@pytest.mark.parametrize(
    ("number", "answer"), [(signal.SIGUSR1, "driver saved"), (signal.SIGTERM, "driver told to go")]
)
def test_signals_reach_the_driver_and_the_job_is_resumable(job: Job, number: signal.Signals, answer: str) -> None:
    process = job.start()
    job.wait_for("driver up")
    process.send_signal(number)
    process.communicate(timeout=30)
    assert process.returncode == 75
    assert job.lines(answer)
    assert not job.lines("scontrol requeue")
    job.wait_for("step ended")


def test_a_job_out_of_time_goes_back_into_the_queue_if_asked(job: Job) -> None:
    assert job.run(DRIVER_EXITS="75", MSK_RAY_REQUEUE="1")[0] == 75
    assert job.lines("scontrol requeue") == ["scontrol requeue 123456"]


def test_a_job_that_failed_does_not(job: Job) -> None:
    assert job.run(DRIVER_EXITS="1", MSK_RAY_REQUEUE="1")[0] == 1
    assert not job.lines("scontrol requeue")


def test_a_job_started_again_goes_on(job: Job) -> None:
    manifest = job.folder / "runs" / "ant_lr" / "manifest.json"
    manifest.parent.mkdir(parents=True)
    manifest.touch()
    job.run(DRIVER_EXITS="0")
    assert "--resume" in job.lines("python -m msk_ray.tune --")[0]


def test_a_node_whose_ray_does_not_start_ends_the_job(job: Job) -> None:
    code, output = job.run(STEP_FAILS="1")
    assert code == 1
    assert "ray start failed on a node" in output
    assert not job.lines("python -m msk_ray.tune --")


def test_nodes_that_do_not_join_in_time_end_the_job(job: Job) -> None:
    code, output = job.run(MSK_RAY_START_LIMIT="0")
    assert code == 1
    assert "not all nodes joined within 0 s" in output


def test_ray_keeps_to_a_folder_of_the_job(job: Job) -> None:
    job.run(DRIVER_EXITS="0")
    assert job.lines("tmp") == ["tmp /tmp/msk_ray-123456"] * 3  # two nodes and the driver
    code, output = job.run(MSK_RAY_TMP="/local/scratch/of/some/department")
    assert code == 2
    assert "MSK_RAY_TMP" in output


def test_usage(job: Job, root: Path) -> None:
    for script in ("slurm.sbatch", "start_or_resume.sh"):
        result = subprocess.run(["bash", root / "cluster" / script, "ant_lr"], capture_output=True, text=True)
        assert result.returncode == 2
        assert result.stderr.startswith("usage: ")
