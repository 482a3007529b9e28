"""Classes named by import path or by an entry point: their settings are read as ours are, and faults are one line."""

import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from msk_ray.config import ENVIRONMENTS, Registry, load_config, parse_config, resolve, settings_class
from msk_ray.envs import env_class
from msk_ray.errors import ConfigError
from msk_ray.registry import python_path

WALKER = """
from msk_ray.config import EnvSettings, Reward
from msk_ray.config.physics import STEPPING

class Walker:
    class Settings(EnvSettings):
        class Reward(Reward):
            speed: float = 2.0
        reads_physics = STEPPING
        episode_length: int = 10
        reward: Reward = Reward()

class Bare: pass

class Silent:
    class Settings(EnvSettings):
        episode_length: int = 10

class Misspelt:
    class Settings(Walker.Settings):
        reads_physics = STEPPING | {"integrater"}

class Owing:
    class Settings(Walker.Settings):
        class Reward(Reward):
            speed: float
        reward: Reward = None
"""


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is imported from, with a module `outside_walker`."""
    (tmp_path / "outside_walker.py").write_text(WALKER)
    (tmp_path / "outside_broken.py").write_text("import outside_walker\n\n1 / 0\n")
    (tmp_path / "outside_needy.py").write_text("import not_installed_at_all\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("outside_")]:
        del sys.modules[name]


def _declare(folder: Path, package: str, target: str, group: str = "msk_ray.envs") -> None:
    """Make `folder` hold an installed package that declares an entry point `walker`."""
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\nwalker = {target}\n")


def test_the_settings_of_an_import_path_are_checked_and_kept_whole(outside: Path) -> None:
    path = outside / "walk.yaml"
    path.write_text("env: {name: 'outside_walker:Walker', reward: {speed: 3}}\n")
    config = load_config(path, ["env.reward.speed=4.5", "env.nworld=3"])
    assert config.env.reward.model_dump() == {"speed": 4.5}
    assert parse_config(config.as_dict()) == config
    assert config.as_dict()["env"]["reward"] == {"speed": 4.5}
    assert pickle.loads(pickle.dumps(config)) == config
    with pytest.raises(ConfigError, match=r"env.reward.sped: unknown key; did you mean 'speed'\?"):
        load_config(path, ["env.reward.sped=4.5"])
    with pytest.raises(ConfigError, match=r"env.speed: unknown key; write env.reward.speed"):
        load_config(path, ["env.speed=4.5"])
    with pytest.raises(ConfigError, match=r"physics.cone: env outside_walker:Walker does not read it; leave it out"):
        load_config(path, ["physics.cone=elliptic"])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            None,
            "env.name: missing; write cartpole, ant, hopper, cheetah, humanoid, g1_tracking, g1_velocity, "
            "go1_velocity, go1_velocity_rough, myoleg,",
        ),
        (3, "env.name: 3 is no name; write cartpole"),
        ("antt", "env.name: unknown name 'antt'; did you mean 'ant'?"),
        ("outside_walker:", "env.name: write package.module:Class, not 'outside_walker:'"),
        ("outside_nothing:Walker", "env.name: no module 'outside_nothing'; the current folder, PYTHONPATH and"),
        ("outside_walker.legs:Walker", "env.name: no module 'outside_walker.legs'"),
        ("outside_walker:Walkr", "env.name: module outside_walker has no 'Walkr'; did you mean 'Walker'?"),
        ("outside_walker:Zzz", "has no 'Zzz'; its classes: Walker, Bare, Silent, Misspelt, Owing"),
        ("outside_broken:Walker", "env.name: importing outside_broken failed: ZeroDivisionError: division by zero ("),
        ("outside_needy:Walker", "importing outside_needy failed: ModuleNotFoundError: No module named 'not_installed"),
        ("outside_walker:Bare", "outside_walker:Bare declares no settings: write `class Settings(EnvSettings)` in it"),
        ("outside_walker:Silent", "do not declare which physics settings they read: write `reads_physics = STEPPING"),
        ("outside_walker:Misspelt", "read physics.integrater, which does not exist; did you mean 'integrator'?"),
        ("outside_walker:Owing", "reward.speed of outside_walker:Owing has no default: policies are scored under"),
    ],
)
def test_what_cannot_be_resolved_is_named_on_one_line(outside: Path, name: object, message: str) -> None:
    env = {} if name is None else {"name": name}
    with pytest.raises(ConfigError) as caught:
        parse_config({"env": env})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_fault_inside_an_imported_module_says_where(outside: Path) -> None:
    with pytest.raises(ConfigError, match=r"outside_broken.py:3\)"):
        resolve("outside_broken:Walker", "env.name")


def test_a_class_that_is_no_environment_is_refused_before_it_is_built(outside: Path) -> None:
    config = parse_config({"env": {"name": "outside_walker:Walker"}})
    with pytest.raises(ConfigError, match=r"outside_walker:Walker is not a subclass of msk_ray.envs.base.Env"):
        env_class(config.env)


def test_an_entry_point_gives_a_short_name(outside: Path) -> None:
    with pytest.raises(ConfigError, match="unknown name 'walker'"):
        parse_config({"env": {"name": "walker"}})
    _declare(outside, "walkers", "outside_walker:Walker")
    config = parse_config({"env": {"name": "walker"}})
    assert (config.env.name, config.env.reward.model_dump()) == ("walker", {"speed": 2.0})
    assert "walker" in ENVIRONMENTS.known()
    with pytest.raises(ConfigError, match="unknown name 'walkre'; did you mean 'walker'"):
        parse_config({"env": {"name": "walkre"}})
    _declare(outside, "others", "outside_walker:Silent")
    with pytest.raises(ConfigError, match=r"'walker' is declared by several packages: write outside_walker:Silent or"):
        parse_config({"env": {"name": "walker"}})


def test_settings_of_an_entry_point_may_stand_apart_from_their_environment(outside: Path) -> None:
    _declare(outside, "walkers", "outside_broken:Walker")
    _declare(outside, "light", "outside_walker:Silent", "msk_ray.env_settings")
    with pytest.raises(ConfigError, match="outside_walker:Silent is not a subclass of"):
        settings_class("walker")
    assert "outside_broken" not in sys.modules


def test_a_name_of_the_package_cannot_be_taken(outside: Path) -> None:
    _declare(outside, "walkers", "outside_walker:Walker")
    assert Registry("env.name", "msk_ray.envs", {"walker": "own:Walker"}).path("walker") == "own:Walker"


def test_reading_a_config_of_ours_loads_neither_torch_nor_warp() -> None:
    code = (
        "import sys; from msk_ray.config import parse_config\n"
        "names = ('cartpole', 'ant', 'hopper', 'cheetah', 'humanoid', 'myoleg26', 'myoleg', 'myosuite_walk')\n"
        "for name in names: parse_config({'env': {'name': name}})\n"
        "print(sorted({'torch', 'warp', 'mujoco', 'ray'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_other_processes_look_for_this_package_first(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f"/theirs::{root}")
    assert python_path() == f"{root}:/theirs"
    monkeypatch.delenv("PYTHONPATH")
    assert python_path() == str(root)
