"""An experiment on two hosts with shared storage, one of which dies in the middle.

The hosts are made on one Linux machine (root needed): each has a network, process and host name namespace of its own,
a link between them, and a raylet of one core, with token authentication. Once trials run on both, everything on the
second is killed at once. Then the experiment must end by itself, with every trial finished and every epoch there once.
"""

import argparse
import json
import os
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

from record import RESULTS, markdown_table, publish

import msk_ray
from msk_ray.config import dump_yaml
from msk_ray.tune.outcomes import read_ending
from msk_ray.tune.records import read_rows
from msk_ray.tune.space import load_space
from msk_ray.tune.trials import resolve_trials

REPOSITORY = Path(msk_ray.__file__).resolve().parent.parent
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


class Host:
    """A host: namespaces of its own, and the processes in them. Its folder for Ray is nobody else's."""

    def __init__(self, name: str, scratch: Path) -> None:
        self.name, self.address = name, ADDRESSES[name]
        self._scratch = scratch
        for folder in (name, "local"):
            (scratch / folder).mkdir(exist_ok=True)
        boot = f"hostname {name} && mount --bind {scratch / name} {scratch / 'local'} && touch {scratch / name / 'up'}"
        spaces = ["unshare", "--uts", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
        self._outside = subprocess.Popen(
            ["ip", "netns", "exec", name, *spaces, "sh", "-c", f"{boot} && exec sleep infinity"]
        )
        while not (scratch / name / "up").exists():
            if self._outside.poll() is not None:
                sys.exit(f"cannot make the host {name}")
            time.sleep(0.05)
        children = Path(f"/proc/{self._outside.pid}/task/{self._outside.pid}/children").read_text().split()
        self._first = children[0]

    def start(self, command: list[str], log: str) -> "subprocess.Popen[bytes]":
        """Run a command there."""
        environment = os.environ | {
            "RAY_TMPDIR": str(self._scratch / "local"),
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN_PATH": str(self._scratch / "token"),
            "PYTHONPATH": os.pathsep.join([str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]),
        }
        environment.pop("RAY_ADDRESS", None)
        into = ["nsenter", "--target", self._first, "--net", "--uts", "--mount", "--pid", f"--wd={REPOSITORY}"]
        with (self._scratch / log).open("ab") as file:
            return subprocess.Popen([*into, *command], stdout=file, stderr=file, env=environment)

    def start_ray(self, head: bool) -> None:
        """Its raylet, of one core."""
        ray = [str(Path(sys.executable).with_name("ray")), "start", "--block", "--num-cpus=1", "--disable-usage-stats"]
        ray += [f"--node-ip-address={self.address}", "--object-store-memory=100000000"]
        where = ["--head", f"--port={PORT}", "--include-dashboard=false"]
        self.start([*ray, *(where if head else [f"--address={ADDRESSES['msk-a']}:{PORT}"])], f"{self.name}.log")

    def kill(self) -> None:
        """Every process there, at once: the first takes all others of its namespace along."""
        self._outside.kill()
        self._outside.wait()


@contextmanager
def _hosts(scratch: Path) -> Iterator[list[Host]]:
    names = list(ADDRESSES)
    for name in names:
        _ip("netns", "add", name)
    try:
        _ip("link", "add", "veth", "netns", names[0], "type", "veth", "peer", "name", "veth", "netns", names[1])
        for name, address in ADDRESSES.items():
            _ip("-n", name, "address", "add", f"{address}/24", "dev", "veth")
            for device in ("lo", "veth"):
                _ip("-n", name, "link", "set", device, "up")
        hosts: list[Host] = []
        try:
            for name in names:
                hosts.append(Host(name, scratch))
            yield hosts
        finally:
            for host in hosts:
                host.kill()
    finally:
        for name in names:
            _ip("netns", "delete", name)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


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
    if os.geteuid() or shutil.which("ip") is None:
        sys.exit("network namespaces need root and the ip command (apt-get install iproute2)")
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
        first.start_ray(head=True)
        second.start_ray(head=False)
        address = f"{first.address}:{PORT}"
        joined = first.start(
            [*python, "msk_ray.tune.cluster", "--address", address, "--nodes", "2", "--wait", "60"], "joined.log"
        )
        if joined.wait():
            sys.exit("the hosts did not find each other:\n" + (scratch / "joined.log").read_text()[-3000:])
        command = ["msk_ray.tune", "--space", str(scratch / "space.yaml"), "--name", "hosts", "--cpu"]
        driver = first.start(
            [*python, *command, "--storage", str(scratch / "runs"), "--address", address], "driver.log"
        )
        log = scratch / "driver.log"
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
