"""The list of tasks: everything that is shipped is in it, and what users add appears by itself."""

import json
from pathlib import Path

import pytest

from msk_ray.__main__ import main
from msk_ray.config import ENVIRONMENTS
from msk_ray.errors import ConfigError
from msk_ray.shipped import CONFIGS, POLICIES, shipped_names
from msk_ray.tasks import Task, find_task, find_tasks, task_table

WALKER = '''
from msk_ray import MjcfEnv


class Walker(MjcfEnv):
    """A walker that
    goes home. It takes its time."""


class Silent(MjcfEnv):
    pass
'''


def listed() -> dict[str, Task]:
    return {task.name: task for task in find_tasks()}


def test_every_environment_config_and_policy_is_listed_with_what_is_learned() -> None:
    tasks = listed()
    assert list(tasks) == ENVIRONMENTS.known()
    configs = [config for task in tasks.values() for config in task.configs]
    assert sorted(configs) == shipped_names(CONFIGS, ".yaml")
    assert sorted(name for task in tasks.values() for name in task.policies) == shipped_names(POLICIES, ".pt")
    for task in tasks.values():
        assert task.configs[0] == task.name, "the config of a task's name comes first"
        assert task.description.endswith("."), task.name
        assert not task.fault
    assert tasks["cartpole"].description == "Swing up a pole on a cart and keep it there."


def test_the_best_policy_is_chosen_under_the_physics_that_scores_are_taken_under() -> None:
    score = listed()["ant"].policies["ant"]
    under = {
        "slow": score.model_copy(update={"mean": 1.0}),
        "fast": score.model_copy(update={"mean": 2.0}),
        "eased": score.model_copy(update={"mean": 3.0, "physics": "other"}),
    }
    assert Task("ant", "", (), under, score.physics).best == "fast"
    assert Task("ant", "", (), {}, score.physics).best is None


def test_a_users_class_appears_with_its_config_and_without_one_by_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("configs").mkdir()
    Path("outside_tasks.py").write_text(WALKER)
    assert find_task("outside_tasks:Walker").configs == ()
    Path("configs/home.yaml").write_text("env: {name: 'outside_tasks:Walker'}")
    task = listed()["outside_tasks:Walker"]
    assert (task.description, task.configs) == ("A walker that goes home.", ("home",))
    Path("configs/home.yaml").write_text("# Without\n# words. More.\nenv: {name: 'outside_tasks:Silent'}")
    assert listed()["outside_tasks:Silent"].description == "Without words."
    Path("configs/home.yaml").write_text("env: {name: 'outside_tasks:Runner'}")
    with pytest.raises(ConfigError, match="has no 'Runner'"):
        find_task("outside_tasks:Runner")
    assert main(["list"]) == 1
    said = capsys.readouterr()
    assert "outside_tasks:Runner" in said.out
    assert said.err.startswith("outside_tasks:Runner: env.name: module outside_tasks has no 'Runner'")


def test_it_is_a_table_or_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--json"]) == 0
    tasks = {task["name"]: task for task in json.loads(capsys.readouterr().out)}
    assert tasks["ant"]["policies"][tasks["ant"]["best"]]["mean"] > 9000
    assert main(["list"]) == 0
    head, _, *rows = capsys.readouterr().out.splitlines()
    assert head.split("  ")[0] == "task"
    assert [row.split()[0] for row in rows] == list(tasks)


def test_what_a_task_lacks_is_a_dash() -> None:
    assert task_table([Task("bare", "", (), {}, "own")], 80).splitlines()[-1].split() == ["bare", *"––––"]
