"""Does every panel of cluster/grafana show something? A real Prometheus scrapes a real sweep and is queried panel by
panel.

Needs the program `prometheus` (apt install prometheus); it uses its own ports and folders. A
sweep of CartPole trains on CPU with cluster/prometheus.yml scraping it; each panel's query goes to Prometheus with the
dashboard's variable set to all experiments, as Grafana sends it. Exit code 1 if a panel stays empty.
"""

import argparse
import json
import math
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from record import markdown_table, publish

from msk_ray.config import dump_yaml
from msk_ray.tune.session_folder import PREFIX

ROOT = Path(__file__).resolve().parents[2]
DASHBOARD = ROOT / "cluster" / "grafana" / "dashboards" / "msk_ray.json"
CONFIG = ROOT / "cluster" / "prometheus.yml"
RAY_FOLDER = "/tmp/ray"
"""Where the Ray of a cluster keeps its files, as `CONFIG` has it."""
PAUSE_S = 2.0
LASTING_S = 60.0
"""Panels must still show something after this time [s]: Ray drops gauges that are not set again."""
SPACE: dict[str, Any] = {
    "question": "Do the gauges arrive?",
    "base": "base.yaml",
    "parameters": {"shac.actor_lr": {"grid": [1e-2, 1e-3]}},
    "seeds": "0-1",
}
TRIALS = 4
"""Of this space."""
BASE: dict[str, Any] = {
    "env": {"name": "cartpole", "nworld": 8, "episode_length": 40},
    "shac": {"horizon": 8, "critic_iterations": 2, "critic_batches": 2},
    "evaluation": {"interval": 2, "nworld": 4, "steps": 20},
    "trial": {"epochs": 1_000_000, "checkpoint_interval": 1000},
}
"""Trials that run until they are stopped."""


@dataclass(frozen=True)
class Query:
    """One query of the dashboard."""

    panel: str
    text: str
    """PromQL, with the dashboard's variables in it."""


def queries() -> list[Query]:
    """Every query of every panel."""
    dashboard = json.loads(DASHBOARD.read_text())
    return [Query(panel["title"], target["expr"]) for panel in dashboard["panels"] for target in panel["targets"]]


def variable() -> tuple[str, str, str]:
    """Name of the dashboard's variable, and the metric and label its values come from."""
    (only,) = json.loads(DASHBOARD.read_text())["templating"]["list"]
    found = re.fullmatch(r"label_values\((\w+), (\w+)\)", only["query"])
    assert found is not None
    return only["name"], found[1], found[2]


class Prometheus:
    """The HTTP interface of a Prometheus on this machine."""

    def __init__(self, port: int) -> None:
        self._url = f"http://127.0.0.1:{port}/api/v1/"

    def _get(self, path: str, **parameters: str) -> Any:
        with urllib.request.urlopen(f"{self._url}{path}?{urllib.parse.urlencode(parameters)}", timeout=30) as answer:
            return json.load(answer)["data"]

    def ready(self) -> bool:
        """Whether it answers yet."""
        try:
            self._get("status/buildinfo")
        except urllib.error.URLError:
            return False
        return True

    def version(self) -> str:
        return str(self._get("status/buildinfo")["version"])

    def label_values(self, metric: str, label: str) -> list[str]:
        return list(self._get(f"label/{label}/values", **{"match[]": metric}))

    def values(self, query: str) -> list[float]:
        """The present value of every series that the query gives."""
        return [float(series["value"][1]) for series in self._get("query", query=query)["result"]]


@contextmanager
def program(command: list[str], log: Path, **environment: str) -> Iterator["subprocess.Popen[bytes]"]:
    """A program that runs meanwhile and is asked to end afterwards."""
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, env=os.environ | environment)
        try:
            yield process
        finally:
            process.terminate()
            process.wait()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def sweep(folder: Path) -> list[str]:
    """The command of the sweep, its files made."""
    (folder / "base.yaml").write_text(dump_yaml(BASE))
    (folder / "gauges.yaml").write_text(dump_yaml(SPACE))
    space, storage = str(folder / "gauges.yaml"), str(folder / "runs")
    return [sys.executable, "-m", "msk_ray.tune", "--space", space, "--cpu", "--storage", storage]


def ask_until_all_answer(
    prometheus: Prometheus, driver: "subprocess.Popen[bytes]", limit_s: float
) -> list[list[float]]:
    """The values of each query once all have some and all trials have a state, and have had for `LASTING_S`.

    Raises:
        SystemExit: the sweep ended by itself, or time is up before that.
    """
    deadline = time.monotonic() + limit_s
    name, metric, label = variable()
    found: list[list[float]] = []
    first = math.inf
    while time.monotonic() < deadline:
        if driver.poll() is not None:
            raise SystemExit(f"the sweep ended with {driver.returncode}")
        if prometheus.ready():
            # "All" is every value there is, as one expression.
            chosen = "|".join(map(re.escape, prometheus.label_values(metric, label)))
            found = [prometheus.values(query.text.replace(f"${name}", f"({chosen})")) for query in queries()]
            # Every trial is in one state, whose gauge is at 1.
            if all(map(shows, found)) and prometheus.values(f"sum({metric})") == [TRIALS]:
                first = min(first, time.monotonic())
                if time.monotonic() - first >= LASTING_S:
                    return found
        time.sleep(PAUSE_S)
    empty = [query.panel for query, values in zip(queries(), found, strict=False) if not shows(values)]
    raise SystemExit(f"after {limit_s:.0f} s, empty: {', '.join(empty) or 'none, but not every trial has one state'}")


def ray_files(folder: Path, driver: "subprocess.Popen[bytes]") -> Path:
    """Where the sweep's Ray keeps its files."""
    while not (found := list(folder.glob(f"{PREFIX}*/ray"))):
        if driver.poll() is not None:
            raise SystemExit(f"the sweep ended with {driver.returncode}")
        time.sleep(PAUSE_S)
    return found[0]


def shows(values: list[float]) -> bool:
    """Whether a panel shows these as something."""
    return bool(values) and all(map(math.isfinite, values))


def main() -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--limit", type=float, default=900.0, metavar="S", help="how long to wait for all panels [s]")
    args = parser.parse_args()
    path = shutil.which("prometheus")
    if path is None:
        print("error: prometheus is not installed: apt install prometheus", file=sys.stderr)
        return 2
    # Below /tmp because Ray's sockets lie there, whose paths may have 107 bytes.
    with tempfile.TemporaryDirectory(prefix="st_", dir="/tmp") as top:
        folder, port = Path(top), free_port()
        text = CONFIG.read_text()
        assert RAY_FOLDER in text
        scraper = [
            path,
            f"--config.file={folder / 'prometheus.yml'}",
            f"--storage.tsdb.path={folder / 'data'}",
            f"--web.listen-address=127.0.0.1:{port}",
        ]
        sweep_log, log = folder / "sweep.log", folder / "prometheus.log"
        with ExitStack() as stack:
            driver = stack.enter_context(program(sweep(folder), sweep_log, RAY_TMPDIR=top))
            files = ray_files(folder, driver)
            (folder / "prometheus.yml").write_text(text.replace(RAY_FOLDER, str(files)))
            stack.enter_context(program(scraper, log))
            prometheus = Prometheus(port)
            try:
                found = ask_until_all_answer(prometheus, driver, args.limit)
                version = prometheus.version()
            except (SystemExit, OSError):
                print(sweep_log.read_text(), log.read_text(), sep="\n", file=sys.stderr)
                raise
    rows = [
        [
            query.panel,
            f"`{query.text.replace('|', chr(92) + '|')}`",
            str(len(values)),
            f"{values[0]:.5g}" if values else "-",
        ]
        for query, values in zip(queries(), found, strict=True)
    ]
    table = markdown_table(["panel", "query", "series", "first value"], rows)
    publish("metrics_stack", f"Panels of the Grafana dashboard, asked of Prometheus {version}", "cpu", table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
