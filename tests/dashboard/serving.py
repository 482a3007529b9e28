"""An experiment to look at, and a dashboard in a thread of this process."""

import asyncio
import http.client
import json
import threading
from pathlib import Path
from typing import Any

from aiohttp import web

from msk_ray.config import dump_yaml
from msk_ray.dashboard.app import make_runner
from msk_ray.dashboard.guard import Access
from msk_ray.dashboard.library import Library
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.outcomes import Ending, Outcome, write_ending
from msk_ray.sweep import opening
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import resolve_trials


def fill(folder: Path, scores: list[float], ended: bool = True) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    rows = [
        {"epoch": n, "env_steps": 100 * n, "seconds": 2.0 * n, "eval/score": score, "grad/actor_norm": 1.0 + n}
        for n, score in enumerate(scores)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if ended:
        write_ending(folder, Ending(Outcome.FINISHED, "all done"))


def make(storage: Path, name: str) -> Experiment:
    """Four trials of a sampled rate and a listed horizon; the last still runs."""
    (storage.parent / "base.yaml").write_text(dump_yaml({"env": {"name": "cartpole"}, "trial": {"epochs": 8}}))
    data = {
        "question": "Which <i>rate</i>?",
        "base": "base.yaml",
        "parameters": {"shac.actor_lr": {"loguniform": [1e-4, 1e-2]}, "shac.horizon": {"choice": [4, 8]}},
        "samples": 4,
    }
    space = parse_space(data, storage.parent / "small.yaml")
    trials = resolve_trials(space)
    made = opening.create(storage / name, space, trials, {})
    for trial in trials:
        fill(made.trial_folder(trial.id), [1.0, 10.0 + trial.index], ended=trial.index < 3)
    return made


class Server:
    """A dashboard in a thread of this process."""

    def __init__(self, library: Library, access: Access) -> None:
        self.port = 0
        self._ready, self._loop = threading.Event(), asyncio.new_event_loop()
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=[self._run(library, access)])
        self._thread.start()
        self._ready.wait()

    async def _run(self, library: Library, access: Access) -> None:
        runner = make_runner(library, access, shutdown_timeout=0.1)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        self.port = runner.addresses[0][1]
        self._ready.set()
        await self._end.wait()
        await runner.cleanup()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()
        self._loop.close()

    def ask(self, path: str, method: str = "GET", body: str | bytes | None = None, **headers: str) -> Any:
        """(status, body, headers) of a request whose path is sent as it is."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port)
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, body, named)
        answer = connection.getresponse()
        parts = answer.status, answer.read().decode(), answer.headers
        connection.close()
        return parts
