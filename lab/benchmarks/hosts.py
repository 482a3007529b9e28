"""Virtual hosts on one Linux machine: separate namespaces for network, processes, host name and mounts, and a link."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import msk_ray

REPOSITORY = Path(msk_ray.__file__).resolve().parent.parent


FIRST = "exec bash -c 'while true; do sleep 3600 & wait; done'"
"""A host's first process: bash, unlike sleep, reaps processes whose parents have ended before them."""


def check_possible() -> None:
    """Exit with a message on what is missing to create hosts."""
    if os.geteuid() or shutil.which("ip") is None:
        sys.exit("network namespaces need root and the ip command (apt-get install iproute2)")


class Host:
    """A host. Whatever runs there ends with it, and it with this program.

    Args:
        name: of the host, and of its network namespace, which exists.
        address: its network address.
        local: a folder that is there for all hosts, and whose content each has for itself.
        disk: where that content lies.
        environment: of all its processes, over this program's own.
    """

    def __init__(self, name: str, address: str, local: Path, disk: Path, environment: Mapping[str, str]) -> None:
        self.name, self.address, self.disk = name, address, disk
        self._environment = {key: text for key, text in os.environ.items() if key != "RAY_ADDRESS"} | {
            "PYTHONPATH": os.pathsep.join([str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]),
            **environment,
        }
        disk.mkdir(parents=True, exist_ok=True)
        local.mkdir(parents=True, exist_ok=True)
        up = disk / "up"
        up.unlink(missing_ok=True)
        boot = f"hostname {name} && mount --bind {disk} {local} && touch {up} && {FIRST}"
        spaces = ["unshare", "--uts", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
        ends_with_us = ["setpriv", "--pdeathsig", "KILL"]
        self._outside = subprocess.Popen([*ends_with_us, "ip", "netns", "exec", name, *spaces, "sh", "-c", boot])
        while not up.exists():
            if self._outside.poll() is not None:
                sys.exit(f"cannot make the host {name}")
            time.sleep(0.05)
        self._first = Path(f"/proc/{self._outside.pid}/task/{self._outside.pid}/children").read_text().split()[0]

    def _into(self, command: list[str]) -> list[str]:
        return [
            "nsenter",
            f"--target={self._first}",
            "--net",
            "--uts",
            "--mount",
            "--pid",
            f"--wd={REPOSITORY}",
            *command,
        ]

    def start(self, command: list[str], log: Path) -> "subprocess.Popen[bytes]":
        """Run a command there; its output goes into a file."""
        with log.open("ab") as file:
            return subprocess.Popen(self._into(command), stdout=file, stderr=file, env=self._environment)

    def ask(self, command: list[str], environment: Mapping[str, str] | None = None) -> str:
        """Run a command there to its end; what it wrote.

        Raises:
            subprocess.CalledProcessError: its exit code is not 0.
        """
        whole = self._environment | dict(environment or {})
        return subprocess.run(self._into(command), stdout=subprocess.PIPE, text=True, env=whole, check=True).stdout

    def kill(self) -> None:
        """Every process there, at once: the first takes all others of its namespace along."""
        self._outside.kill()
        self._outside.wait()


@contextmanager
def network(addresses: Mapping[str, str]) -> Iterator[None]:
    """Network namespaces of two hosts, linked; gone afterwards."""
    made: list[str] = []
    try:
        for name in addresses:
            _ip("netns", "add", name)
            made.append(name)
        first, second = addresses
        _ip("link", "add", "veth", "netns", first, "type", "veth", "peer", "name", "veth", "netns", second)
        for name, address in addresses.items():
            _ip("-n", name, "address", "add", f"{address}/24", "dev", "veth")
            for device in ("lo", "veth"):
                _ip("-n", name, "link", "set", device, "up")
        yield
    finally:
        for name in made:
            _ip("netns", "delete", name)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)
