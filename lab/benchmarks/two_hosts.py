"""An experiment on two hosts with shared storage, one of which dies in the middle.

The hosts are made on one Linux machine (root needed): each has a network, process and host name namespace of its own,
a link between them, and a raylet of one core, with token authentication. Once trials run on both, everything on the
second is killed at once. Then the experiment must end by itself, with every trial finished and every epoch there once.
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
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hosts import Host, check_possible, network
from record import RESULTS, markdown_table, publish

from msk_ray.config import dump_yaml
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.outcomes import read_ending
from msk_ray.sweep.space import load_space
from msk_ray.sweep.trials import resolve_trials

EPOCHS = 30
SPACE = {
    "question": "Does an experiment survive the loss of a host?",
    "base": "configs/cartpole.yaml",
    "overrides": {
        "env.nworld": 64,
        "evaluation.interval": 5,
        "evaluation.steps": 32,
        "trial.epochs": EPOCHS,
        "trial.checkpoint_interval": 5,
    },
    "seeds": "0-2",
}
ADDRESSES = {"msk-a": "10.214.77.1", "msk-b": "10.214.77.2"}
"""Host names, which are their namespaces' too, and addresses."""
PORT = 6379
LIMIT_S = 900.0


def _start_ray(host: Host, log: Path, *where: str) -> None:
    """Its raylet, of one core."""
    ray = [str(Path(sys.executable).with_name("ray")), "start", "--block", "--num-cpus=1", "--disable-usage-stats"]
    host.start([*ray, f"--node-ip-address={host.address}", "--object-store-memory=100000000", *where], log)


def _wait_for_nodes(host: Host, address: str, count: int, log: Path) -> None:
    command = ["msk_ray.tune.cluster", "--address", address, "--nodes", str(count), "--wait", str(LIMIT_S)]
    if host.start([sys.executable, "-m", *command], log).wait():
        sys.exit("the hosts did not find each other:\n" + log.read_text()[-3000:])


@contextmanager
def _hosts(scratch: Path) -> Iterator[list[Host]]:
    environment = {
        "RAY_TMPDIR": str(scratch / "local"),
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN_PATH": str(scratch / "token"),
    }
    with network(ADDRESSES):
        hosts: list[Host] = []
        try:
            for name, address in ADDRESSES.items():
                hosts.append(Host(name, address, scratch / "local", scratch / name, environment))
            yield hosts
        finally:
            for host in hosts:
                host.kill()


def _wait(what: str, condition: object, driver: "subprocess.Popen[bytes]", log: Path) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not condition():  # type: ignore[operator]
        if driver.poll() is not None or time.monotonic() > deadline:
            sys.exit(f"{what}: not within {LIMIT_S:.0f} s, driver {driver.poll()}:\n{log.read_text()[-3000:]}")
        time.sleep(0.1)


def _running(trials: Path) -> dict[str, set[str]]:
    """Trials at work that have written rows, by host."""
    found: dict[str, set[str]] = {name: set() for name in ADDRESSES}
    for folder in trials.iterdir() if trials.is_dir() else ():
        if (folder / "device.json").is_file() and read_ending(folder) is None and len(read_rows(folder)) > 10:
            found[json.loads((folder / "device.json").read_text())["host"]].add(folder.name)
    return found


def main() -> int:
    """Run it; 1 if anything was lost."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    p.add_argument("--keep", action="store_true", help="keep the experiment and logs")
    args = p.parse_args()
    check_possible()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(number))
    # Ray's sockets lie below, and their paths may have 107 bytes.
    scratch = Path(tempfile.mkdtemp(prefix="hosts_", dir="/tmp"))
    started = time.monotonic()
    token = scratch / "token"
    token.touch(mode=0o600)
    token.write_text(secrets.token_hex(32))
    (scratch / "space.yaml").write_text(dump_yaml(SPACE))
    trials = resolve_trials(load_space(scratch / "space.yaml"))
    folder = scratch / "runs" / "hosts" / "trials"
    python = [sys.executable, "-m"]
    with _hosts(scratch) as (first, second):
        address = f"{first.address}:{PORT}"
        _start_ray(first, scratch / f"{first.name}.log", "--head", f"--port={PORT}", "--include-dashboard=false")
        _wait_for_nodes(first, address, 1, scratch / "joined.log")
        # A raylet that comes before the head is up gives up soon.
        _start_ray(second, scratch / f"{second.name}.log", f"--address={address}")
        _wait_for_nodes(first, address, 2, scratch / "joined.log")
        log = scratch / "driver.log"
        command = ["msk_ray.tune", "--space", str(scratch / "space.yaml"), "--name", "hosts", "--cpu"]
        driver = first.start([*python, *command, "--storage", str(scratch / "runs"), "--address", address], log)
        _wait("trials on both hosts", lambda: all(_running(folder).values()), driver, log)
        lost = _running(folder)[second.name]
        print(f"at {time.monotonic() - started:.0f} s: trials on both hosts; killing {second.name}", flush=True)
        second.kill()
        killed = time.monotonic()
        try:
            code = driver.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            sys.exit(f"the experiment did not end within {LIMIT_S:.0f} s:\n{log.read_text()[-3000:]}")
        after = time.monotonic() - killed
    rows, failures = [], code
    for trial in trials:
        path = folder / trial.id
        ending = read_ending(path)
        epochs = [row["epoch"] for row in read_rows(path)]
        missing = EPOCHS + 1 - len(set(epochs) & set(range(EPOCHS + 1)))
        finished = ending is not None and ending.outcome == "finished"
        failures += missing + (not finished)
        host = json.loads((path / "device.json").read_text())["host"]
        began = f"{second.name}, lost" if trial.id in lost else host
        rows.append([trial.id, began, host, ending.outcome if ending else "-", f"{missing}"])
    header = ["trial", "began on", "ended on", "outcome", "rows missing"]
    note = f"\nExit code {code}, {after:.0f} s after the loss of {second.name}."
    title = f"Two hosts, {len(trials)} CartPole trials of {EPOCHS} epochs, one host lost"
    publish("two_hosts", title, "cpu", markdown_table(header, rows) + "\n" + note, args.results)
    if args.keep:
        print(f"kept: {scratch}")
    else:
        shutil.rmtree(scratch)
    return 1 if failures or not lost else 0


if __name__ == "__main__":
    sys.exit(main())
