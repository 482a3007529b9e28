"""`msk-ray list`: the tasks that can be trained.

A task is an environment. Nothing is registered for the list: it reads the names of environments, their docstrings, and
the files in `configs/` and `policies/`, of the package and of the current folder.
"""

import inspect
import itertools
import json
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msk_ray.cli import Parser, run
from msk_ray.config import ENVIRONMENTS, EnvSettings, env_name, read_config, settings_class
from msk_ray.config.environments import SETTINGS
from msk_ray.errors import ConfigError, MskRayError
from msk_ray.evaluate.targets import OWN
from msk_ray.evaluate.zoo import Score, read_entry
from msk_ray.registry import resolve
from msk_ray.shipped import CONFIGS, POLICIES, find_shipped, shipped_names
from msk_ray.text import printable
from msk_ray.text_table import text_table

DESCRIPTION = """\
List the tasks that can be trained: their names, what is learned, the configs in configs/ that train them, and the score
of the best policy in policies/.

A task is an environment of this package or of another installed one, or a class of yours that a file in configs/ of the
current folder names. Scores are taken under the task's reference physics; --json also lists policies with scores under
other physics."""

EXAMPLES = """\
  msk-ray list
  msk-ray list --json | jq -r '.[].name'
  msk-ray train --config ant_fast        # train one of a task's configs
  msk-ray play ant                       # watch its best policy in policies/"""


@dataclass(frozen=True)
class Task:
    """A task with its configs and policies."""

    name: str
    """What `env.name` takes."""
    description: str
    """What is learned, in one sentence; empty if nothing says so."""
    configs: tuple[str, ...]
    """Names in `configs/`; the one named after the task comes first."""
    policies: Mapping[str, Score]
    """Scores of its policies in `policies/`, by name."""
    physics: str
    """The physics that its scores are compared under."""
    fault: str = ""
    """Why the task, or one of its files, cannot be read."""

    @property
    def best(self) -> str | None:
        """The name of its policy with the best score under its reference physics."""
        compared = {name: score.mean for name, score in self.policies.items() if score.physics == self.physics}
        return max(compared, key=lambda name: compared[name], default=None)

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        policies = {name: score.model_dump() for name, score in self.policies.items()}
        return {
            "name": self.name,
            "description": self.description,
            "configs": list(self.configs),
            "best": self.best,
            "policies": policies,
            "fault": self.fault,
        }


def find_tasks() -> list[Task]:
    """Every task, in the order of their registration, then those that only configs name.

    Raises:
        ConfigError: a file in `configs/` is no config. StorageError, CheckpointError: one in `policies/` is damaged.
    """
    configs: dict[str, list[str]] = {name: [] for name in ENVIRONMENTS.known()}
    for config in shipped_names(CONFIGS, ".yaml"):
        name = env_name(read_config(_path(config, CONFIGS, ".yaml")))
        if name is not None:
            configs.setdefault(name, []).append(config)
    policies: dict[str, dict[str, Score]] = {}
    for policy in shipped_names(POLICIES, ".pt"):
        path = _path(policy, POLICIES, ".pt")
        if path.with_suffix(".yaml").is_file():  # else nothing records a score
            entry = read_entry(path)
            policies.setdefault(entry.env, {})[policy] = entry.score
    return [_task(name, tuple(names), policies.get(name, {})) for name, names in configs.items()]


def find_task(name: str) -> Task:
    """The task of this name, or of a class `package.module:Class`.

    Raises:
        ConfigError: there is none, or it cannot be read. StorageError, CheckpointError: as for `find_tasks`.
    """
    task = next((task for task in find_tasks() if task.name == name), None)
    if task is None:
        ENVIRONMENTS.path(name)
        task = _task(name, (), {})
    if task.fault:
        raise ConfigError(task.fault)
    return task


def _path(name: str, folder: str, suffix: str) -> Path:
    path = find_shipped(name, folder, suffix)
    assert path is not None, "it was listed just now"
    return path


def _task(name: str, configs: tuple[str, ...], policies: Mapping[str, Score]) -> Task:
    configs = tuple(sorted(configs, key=lambda config: (config != name, config)))
    try:
        settings = settings_class(name)
        description = _description(name, settings, configs)
    except MskRayError as error:
        return Task(name, "", configs, policies, OWN, str(error))
    return Task(name, description, configs, policies, (*settings.variants, OWN)[0])


def _description(name: str, settings: type[EnvSettings], configs: Sequence[str]) -> str:
    """The first sentence of the docstring of the settings, if they can be imported without the environment, or else of
    the environment's class; or of the comment above its first config."""
    owner = settings if SETTINGS.find(name) else resolve(ENVIRONMENTS.path(name), ENVIRONMENTS.key)
    text = inspect.cleandoc(owner.__doc__ or "")
    if not text and configs:
        lines = _path(configs[0], CONFIGS, ".yaml").read_text(encoding="utf-8").splitlines()
        text = "\n".join(line.lstrip("# ") for line in itertools.takewhile(lambda line: line.startswith("#"), lines))
    paragraph = " ".join(text.partition("\n\n")[0].split())
    return re.split(r"(?<=\.) ", paragraph, maxsplit=1)[0]


def parser() -> Parser:
    """The command line."""
    p = Parser("msk-ray list", DESCRIPTION, EXAMPLES)
    p.add_argument("--json", action="store_true", help="print a JSON array instead of the table")
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code: 1 if a task cannot be read."""
    args = parser().parse_args(argv)
    tasks = find_tasks()
    if args.json:
        print(json.dumps([task.plain() for task in tasks], indent=2))
    else:
        print(task_table(tasks, shutil.get_terminal_size((160, 24)).columns))
        for task in tasks:
            if task.fault:
                print(printable(f"{task.name}: {task.fault}"), file=sys.stderr)
    return 1 if any(task.fault for task in tasks) else 0


def task_table(tasks: Sequence[Task], width: int) -> str:
    """A line for each task, for a terminal of `width` columns."""
    rows = []
    for task in tasks:
        score = "–" if task.best is None else f"{task.policies[task.best].mean:.5g}"
        rows.append((task.name, task.description or "–", score, task.best or "–", ", ".join(task.configs) or "–"))
    return text_table(("task", "what is learned", "score", "policy", "configs"), rows, width)


if __name__ == "__main__":
    sys.exit(run(main))
