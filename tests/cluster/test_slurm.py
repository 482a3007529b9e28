"""The SLURM scripts run for real, with fakes for SLURM, Ray and Python that write down how they were called."""

import contextlib
import fcntl
import os
import re
import shutil
import signal
import stat
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import wait_until

pytestmark = pytest.mark.long

PAUSE = """
        if [ "$PAUSE_AT" = {name} ]; then
            echo "paused" >> "$LOG"
            while [ ! -e "$GO" ]; do /bin/sleep 0.02; done
        fi"""
"""A fake that takes its time."""
FAKES = {
    "scontrol": """
        echo "scontrol $*" >> "$LOG"
        if [ "$1" = requeue ]; then exit "${REQUEUE_FAILS:-0}"; fi"""
    + PAUSE.format(name="scontrol")
    + """
        printf 'node1\\nnode2\\n'""",
    "sleep": "exec /bin/sleep 0.02",
    "hostname": PAUSE.format(name="hostname") + "\necho '10.0.0.1 192.168.0.1'",
    # Both nodes are this machine: the second has its folder beside the first's.
    "srun": """
        echo "srun $*" >> "$LOG"
        if [ -n "$STEP_FAILS" ]; then exit 1; fi
        case "$*" in *--nodelist=node1*) place= ;; *) place=-node2 ;; esac
        while [ "${1#--}" != "$1" ]; do shift; done
        script=$1 folder=$2
        shift 2
        export JOBS_TMPDIR=$folder RAY_TMPDIR=$folder$place RAY_AUTH_TOKEN_PATH=$folder$place/token
        exec "$script" "$folder$place" "$@" """,
    # It is told to end again and again until it has ended, and writes that down once.
    "ray": """
        trap 'trap "" TERM; echo step ended >> "$LOG"; exit 0' TERM
        echo "ray $*" >> "$LOG"
        stat -c 'token %a' "$RAY_AUTH_TOKEN_PATH" >> "$LOG"
        stat -c 'folder %a' "$RAY_TMPDIR" >> "$LOG"
        echo "mode $RAY_AUTH_MODE, $(wc -c < "$RAY_AUTH_TOKEN_PATH") characters" >> "$LOG"
        echo "tmp $JOBS_TMPDIR" >> "$LOG"
        while true; do /bin/sleep 0.02; done""",
    # Without a trap, as Python is until its first lines have run.
    "python": """
        echo "python $*" >> "$LOG"
        case "$*" in
        *msk_ray.tune.cluster*)"""
    + PAUSE.format(name="joining")
    + """
            if [ -n "$STEP_FAILS" ] || [ ! -e joined ]; then touch joined; exit 1; fi
            if [ "$(grep -cx "tmp $RAY_TMPDIR" "$LOG")" -lt "${!#}" ]; then exit 1; fi
            exit 0 ;;
        esac
        echo "tmp $RAY_TMPDIR" >> "$LOG"
        if [ "$PAUSE_AT" = imports ]; then
            echo paused >> "$LOG"
            while true; do /bin/sleep 0.02; done
        fi
        trap 'echo driver saved >> "$LOG"; exit 75' USR1 TERM
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
    # Sockets need a short path.
    made = Job(tmp_path, root / "cluster", Path(tempfile.mkdtemp(dir="/tmp", prefix="")))
    yield made
    for process in made.started:
        with contextlib.suppress(ProcessLookupError):  # all of it has ended
            os.killpg(process.pid, signal.SIGKILL)
        if process.stdout is not None and not process.stdout.closed:  # its output has not been read
            process.communicate()
    shutil.rmtree(made.disk)


class Job:
    """A submitted job."""

    def __init__(self, folder: Path, scripts: Path, disk: Path) -> None:
        self.folder, self.scripts, self.disk, self.log = folder, scripts, disk, folder / "log"
        self.started: list[subprocess.Popen[str]] = []
        self.environment = {
            "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
            "LOG": str(self.log),
            "GO": str(folder / "go"),
            "SLURM_SUBMIT_DIR": str(folder / "project"),
            "SLURM_JOB_ID": "123456",
            "SLURM_JOB_NODELIST": "node[1-2]",
            "SLURM_CPUS_PER_TASK": "16",
            "MSK_RAY_BIN": str(folder / "bin"),
            "MSK_RAY_TMP": str(disk),
        }

    def start(self, *options: str, script: str = "slurm.sbatch", **environment: str) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            ["bash", str(self.scripts / script), "ant_lr", str(self.folder / "runs"), *options],
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
        return self.end(self.start(*options, **environment))

    def end(self, process: "subprocess.Popen[str]") -> tuple[int, str]:
        """Exit code and output of one that is about to end."""
        output, _ = process.communicate()
        return process.returncode, output

    def lines(self, beginning: str) -> list[str]:
        text = self.log.read_text() if self.log.exists() else ""
        return [line for line in text.splitlines() if line.startswith(beginning)]

    def wait_for(self, line: str, count: int = 1) -> None:
        wait_until(lambda: len(self.lines(line)) >= count)

    def left_over(self) -> list[str]:
        """What the job left in the project's folder."""
        return sorted(path.name for path in (self.folder / "project").iterdir())

    def tokens(self) -> list[Path]:
        """On the nodes' disk."""
        return sorted(path for path in self.disk.rglob("*") if path.is_file())


@pytest.mark.parametrize("code", [0, 1, 2, 130])
def test_the_drivers_exit_code_is_the_jobs(job: Job, code: int) -> None:
    assert job.run(DRIVER_EXITS=str(code))[0] == code
    assert job.left_over() == ["cluster", "joined"]
    assert not job.tokens()


def test_head_workers_and_driver(job: Job) -> None:
    job.run("--seeds", "0-4", DRIVER_EXITS="0")
    head, worker = job.lines("srun")
    for line in (head, worker):
        assert "--nodes=1 --ntasks=1 --overlap" in line
        assert "ray start --block" in line
        assert "--num-cpus=16" in line
    assert "--nodelist=node1" in head
    assert "--head --node-ip-address=10.0.0.1 --port=33824" in head
    assert "--dashboard-host=127.0.0.1" in head
    assert "--nodelist=node2" in worker
    assert "--address=10.0.0.1:33824" in worker
    checks, (driver,) = job.lines("python -m msk_ray.tune.cluster"), job.lines("python -m msk_ray.tune --")
    # The first node alone, asked again until it is there; then both.
    asked = [line.removeprefix("python -m msk_ray.tune.cluster --address 10.0.0.1:33824 --nodes ") for line in checks]
    assert asked[:2] == ["1", "1"]
    assert asked == sorted(asked)
    assert asked[-1] == "2"
    lines = job.log.read_text().splitlines()
    assert lines.index(worker) > max(number for number, line in enumerate(lines) if line.endswith("--nodes 1"))
    storage = job.folder / "runs"
    expected = f"--space ant_lr --storage {storage} --start-or-resume --seeds 0-4 --address 10.0.0.1:33824"
    assert driver == f"python -m msk_ray.tune {expected}"


def test_the_token_is_for_its_owner_alone_and_goes_with_the_job(job: Job) -> None:
    process = job.start()
    job.wait_for("driver up")
    first, second = job.tokens()
    assert first.read_text() == second.read_text()
    assert re.fullmatch("[0-9a-f]{64}", first.read_text())
    for token in (first, second):
        assert stat.S_IMODE(token.stat().st_mode) == 0o600
        assert stat.S_IMODE(token.parent.stat().st_mode) == 0o700
    assert first.read_text() not in job.log.read_text()  # no command line shows it
    process.send_signal(signal.SIGTERM)
    job.end(process)
    assert not job.tokens()
    assert set(job.lines("token")) == {"token 600"}
    assert set(job.lines("folder")) == {"folder 700"}
    assert set(job.lines("mode")) == {"mode token, 64 characters"}


def test_a_killed_jobs_token_goes_when_the_next_one_starts_and_a_living_ones_stays(job: Job) -> None:
    process = job.start()
    job.wait_for("driver up")
    killed = job.tokens()
    os.killpg(process.pid, signal.SIGKILL)
    job.end(process)
    assert job.left_over() == ["cluster", "joined"]
    assert all(token.exists() for token in killed)
    elsewhere = job.folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "precious").touch()
    (job.disk / "msk_ray-1-abcdef").symlink_to(elsewhere)
    living = job.disk / "msk_ray-2-abcdef"
    living.mkdir()
    held = os.open(living, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    job.run(DRIVER_EXITS="0")
    os.close(held)
    assert not any(token.exists() for token in killed)
    assert (elsewhere / "precious").exists()
    assert living.exists()


def test_nodes_that_clean_up_at_the_same_time_do_not_disturb_each_other(job: Job) -> None:
    """One of them finds a folder gone that it has just seen."""
    for number in range(300):
        (job.disk / f"msk_ray-1-{number:06}").mkdir()
    nodes = [
        subprocess.Popen(
            ["bash", job.scripts / "slurm_node.sh", job.disk / f"msk_ray-2-{number:06}", "true"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        for number in range(4)
    ]
    job.started += nodes
    assert [job.end(node)[0] for node in nodes] == [0] * 4
    assert not list(job.disk.glob("msk_ray-1-*"))


def test_a_node_takes_no_folder_that_is_there_already(job: Job) -> None:
    folder = job.disk / "msk_ray-1-abcdef"
    (job.disk / "new-msk_ray-1-abcdef").mkdir(mode=0o777)
    result = subprocess.run(
        ["bash", job.scripts / "slurm_node.sh", folder, "true"], input="secret", capture_output=True, text=True
    )
    assert result.returncode != 0
    assert "File exists" in result.stderr
    assert not job.tokens()


@pytest.mark.parametrize("number", [signal.SIGUSR2, signal.SIGTERM])
def test_a_node_ends_in_order_when_all_of_its_step_is_signalled(job: Job, number: signal.Signals) -> None:
    """As SLURM signals steps. What asks the driver to stop does not end the Ray that the driver still needs."""
    folder = job.disk / "msk_ray-1-abcdef"
    process = subprocess.Popen(
        ["bash", job.scripts / "slurm_node.sh", folder, "ray"],
        env=job.environment | {"RAY_TMPDIR": str(folder), "RAY_AUTH_TOKEN_PATH": str(folder / "token")},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    job.started.append(process)
    assert process.stdin is not None
    process.stdin.close()
    process.stdin = None
    job.wait_for("tmp")
    for ignored in (signal.SIGUSR1, signal.SIGHUP, signal.SIGINT):
        os.killpg(process.pid, ignored)
    assert folder.exists()
    assert process.poll() is None
    os.killpg(process.pid, number)
    assert job.end(process)[0] == 0
    assert job.lines("step ended")
    assert not job.tokens()


def test_a_node_whose_ray_ends_by_itself_has_failed(job: Job) -> None:
    folder = job.disk / "msk_ray-1-abcdef"
    assert subprocess.run(["bash", job.scripts / "slurm_node.sh", folder, "false"], input=b"secret").returncode == 1
    assert not job.tokens()


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_signals_reach_the_driver_and_the_job_is_resumable(job: Job, number: signal.Signals) -> None:
    process = job.start()
    job.wait_for("driver up")
    process.send_signal(number)
    assert job.end(process)[0] == 75
    assert job.lines("driver saved")
    assert not job.lines("scontrol requeue")
    assert len(job.lines("step ended")) == 2


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTERM])
@pytest.mark.parametrize("place", ["scontrol", "hostname", "joining", "imports"])
def test_a_signal_before_the_driver_can_save_leaves_the_job_resumable(
    job: Job, place: str, number: signal.Signals
) -> None:
    process = job.start(PAUSE_AT=place, MSK_RAY_REQUEUE="1")
    job.wait_for("paused")
    process.send_signal(number)
    (job.folder / "go").touch()
    assert job.end(process)[0] == 75
    assert not job.lines("driver up")
    # TERM: it was cancelled, or SLURM itself puts it back.
    assert job.lines("scontrol requeue") == (["scontrol requeue 123456"] if number == signal.SIGUSR1 else [])
    assert not job.tokens()


@pytest.mark.parametrize("script", ["slurm.sbatch", "start_or_resume.sh"])
@pytest.mark.parametrize("place", ["imports", "nowhere"])
def test_a_signal_to_the_whole_group(job: Job, script: str, place: str) -> None:
    process = job.start(script=script, PAUSE_AT=place, MSK_RAY_PYTHON=str(job.folder / "bin" / "python"))
    job.wait_for("paused" if place == "imports" else "driver up")
    os.killpg(process.pid, signal.SIGUSR1)
    assert job.end(process)[0] == 75


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTERM, signal.SIGHUP])
def test_start_or_resume_ends_resumably_before_python_is_up(job: Job, number: signal.Signals) -> None:
    python = str(job.folder / "bin" / "python")
    process = job.start(script="start_or_resume.sh", PAUSE_AT="imports", MSK_RAY_PYTHON=python)
    job.wait_for("paused")
    process.send_signal(number)
    assert job.end(process)[0] == 75


def test_a_driver_that_somebody_else_kills_has_failed(job: Job) -> None:
    process = job.start(script="start_or_resume.sh", MSK_RAY_PYTHON=str(job.folder / "bin" / "python"))
    job.wait_for("driver up")
    (driver,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()[:1]
    os.kill(int(driver), signal.SIGKILL)
    assert job.end(process)[0] == 128 + signal.SIGKILL


def test_a_job_out_of_time_goes_back_into_the_queue_if_asked(job: Job) -> None:
    assert job.run(DRIVER_EXITS="75", MSK_RAY_REQUEUE="1")[0] == 75
    assert job.lines("scontrol requeue") == ["scontrol requeue 123456"]


def test_a_queue_that_does_not_take_it_back_leaves_it_resumable(job: Job) -> None:
    code, output = job.run(DRIVER_EXITS="75", MSK_RAY_REQUEUE="1", REQUEUE_FAILS="1")
    assert code == 75
    assert "error: scontrol requeue failed; submit the job again" in output


def test_a_job_that_is_cancelled_does_not_go_back(job: Job) -> None:
    process = job.start(MSK_RAY_REQUEUE="1")
    job.wait_for("driver up")
    process.send_signal(signal.SIGTERM)
    assert job.end(process)[0] == 75
    assert job.lines("driver saved")
    assert not job.lines("scontrol requeue")


def test_a_job_that_failed_does_not(job: Job) -> None:
    assert job.run(DRIVER_EXITS="1", MSK_RAY_REQUEUE="1")[0] == 1
    assert not job.lines("scontrol requeue")


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
    job.run(DRIVER_EXITS="0")  # put back into the queue, a job keeps its number
    used = job.lines("tmp")
    assert len(used) == 6  # two nodes and the driver, twice
    assert len(set(used)) == 2
    assert all(re.fullmatch(rf"tmp {job.disk}/msk_ray-123456-[0-9a-f]{{6}}", line) for line in used)
    code, output = job.run(MSK_RAY_TMP="/local/scratch/of/some/department")
    assert code == 2
    assert "MSK_RAY_TMP" in output


def test_usage(job: Job, root: Path) -> None:
    for script in ("slurm.sbatch", "start_or_resume.sh"):
        result = subprocess.run(["bash", root / "cluster" / script, "ant_lr"], capture_output=True, text=True)
        assert result.returncode == 2
        assert result.stderr.startswith("usage: ")
