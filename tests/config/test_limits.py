"""Values, sizes and depths no setting may have: refused at once, by one short line."""

from pathlib import Path
from typing import Any

import pytest

from msk_ray import train
from msk_ray.cli import run
from msk_ray.config import Config, load_config, overlay, parse_config, parse_overrides, parse_yaml, read_yaml
from msk_ray.config.schema import PhysicsConfig
from msk_ray.config.sections import Section
from msk_ray.config.yaml_text import MAX_BYTES
from msk_ray.errors import ConfigError
from msk_ray.sweep.space import ResourcesSpec, SpaceFile, parse_seeds, parse_space
from msk_ray.tune import __main__ as tune
from msk_ray.tune.devices import choose_placement

CARTPOLE = {"env": {"name": "cartpole"}}
BOMB = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{new}: &{new} [{','.join([f'*{old}'] * 10)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        pytest.param("a: " + "[" * 5000 + "]" * 5000, "more than 32 mappings and lists", id="deep list"),
        pytest.param("{a: " * 5000, "more than 32 mappings and lists", id="deep mapping"),
        pytest.param(BOMB, "values once its aliases are written out", id="aliases that multiply"),
        pytest.param(
            "a0: &a0 [1]\n" + "".join(f"a{i + 1}: &a{i + 1} [*a{i}]\n" for i in range(5000)),
            "more than 32 mappings and lists",
            id="aliases that nest",
        ),
        pytest.param("a: &a [*a]", "refers to a value that contains it", id="alias of itself"),
        pytest.param("a: 1\nb: 2\na: 3", "key 'a' is written twice", id="a key twice"),
        pytest.param("a: 0x" + "f" * 5000, "below 2^63", id="a huge hexadecimal number"),
        pytest.param("a: " + "9" * 5000, "not valid YAML", id="a huge decimal number"),
        pytest.param("? [1]\n: 2", "a key must be a name", id="a list as key"),
        pytest.param(
            "overrides: {5: 64}", "key '5' is a whole number in YAML, not a name; write a", id="a number as key"
        ),
        pytest.param("a: {on: 1}", "key 'on' is true or false in YAML, .* write a name, in quotes", id="on as key"),
        pytest.param("a: {~: 1}", "key '~' is null in YAML", id="null as key"),
        pytest.param("a: {.5: 1}", "key '.5' is a number in YAML", id="a fraction as key"),
        pytest.param("a: !!bool maybe", "leave out the tag", id="a tag"),
        pytest.param("a: !!python/object/apply:os.getpid []", "leave out the tag", id="an object"),
        pytest.param('a: "\\ud800"', "surrogates not allowed", id="half a character"),
        pytest.param("a: 1\n---\nb: 2", "single document", id="two documents"),
        pytest.param("a: " + "x" * MAX_BYTES, "too large for settings", id="a large document"),
    ],
)
def test_yaml_that_no_setting_needs_is_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message.replace("^", r"\^")) as caught:
        parse_yaml(text, "here")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"bad\.yaml"):
        read_yaml(path)


def test_yaml_that_settings_use_is_read() -> None:
    data = parse_yaml("a: &x {p: 1, q: .5}\nb: {<<: *x, p: 2}\nc: [*x, *x]\nwhen: 2026-01-01\n'on': 1", "here")
    assert data["on"] == 1
    assert data["b"] == {"p": 2, "q": 0.5}
    assert data["c"] == [{"p": 1, "q": 0.5}] * 2
    assert data["when"] == "2026-01-01", "a date is text, here and as a label"


def _fields(section: type[Section], prefix: str = "") -> list[str]:
    """Dotted names of the settings below a section that have a default."""
    names = []
    for name, field in section.model_fields.items():
        if isinstance(field.default, Section):
            names += _fields(type(field.default), f"{prefix}{name}.")
        elif name not in ("env", "name"):
            names.append(prefix + name)
    return names


SETTINGS = _fields(Config)


def _default(dotted: str) -> Any:
    node: Any = parse_config(CARTPOLE)
    for part in dotted.split("."):
        node = getattr(node, part)
    return node


@pytest.mark.parametrize("setting", [name for name in SETTINGS if not isinstance(_default(name), bool)])
def test_no_setting_takes_truth_for_a_number(setting: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(overlay(CARTPOLE, {setting: True}))
    assert setting in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", ["inf", "-inf", "nan"])
@pytest.mark.parametrize(
    "setting", ["physics.timestep", "shac.state_grad_clip", *(s for s in SETTINGS if isinstance(_default(s), float))]
)
def test_numbers_are_finite(setting: str, value: str) -> None:
    for written in (float(value), value):
        with pytest.raises(ConfigError, match=rf"{setting}\b"):
            parse_config(overlay(CARTPOLE, {setting: written}))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("shac.actor_lr=.inf", "shac.actor_lr: Input should be a finite number, not inf"),
        ("shac.actor_lr=true", "shac.actor_lr: Input should be a valid number, not true"),
        ("trial.epochs=true", "trial.epochs: Input should be a valid integer, not true"),
        ("physics.solref=[true, 0.9]", "not true"),
        ("shac.horizon=true", "shac.horizon: Input should be a valid integer, not true"),
        ("env.nworld=100000000000", "env.nworld: Input should be less than 2147483648"),
        ("actor.hidden=[64, 1000000]", "actor.hidden.1: Input should be less than or equal to 65536"),
        (f"actor.hidden=[{','.join(['8'] * 100)}]", "actor.hidden: Tuple should have at most 64 items"),
        (f"trial.start_from={'x' * 5000}", "trial.start_from: String should have at most 4096 characters"),
        (f"{'a.' * 5000}b=1", "no setting is 5001 sections deep"),
        (f"shac.horizon={'[' * 5000}", "more than 32 mappings"),
    ],
)
def test_train_refuses_by_one_short_line(
    override: str, message: str, root: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    argv = ["--config", str(root / "configs" / "cartpole.yaml"), "--logdir", str(tmp_path / "log"), "--set", override]
    assert run(train.main, argv) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    assert len(error) < 700
    assert not (tmp_path / "log").exists()


def test_a_large_value_is_not_printed_whole() -> None:
    huge = "x" * 3_600_000
    for data in (
        {**CARTPOLE, "shac": {"horizon": huge}},
        {**CARTPOLE, "shac": {huge: 1}},
        {"env": {"name": huge}},
        {**CARTPOLE, "physics": {"solref": [huge] * 3}},
        {**CARTPOLE, "physics": {"variant": huge[:4000]}},
        {**CARTPOLE, "shac": list(range(1_000_000))},
    ):
        with pytest.raises(ConfigError) as caught:
            parse_config(data)
        assert len(str(caught.value)) < 500
    with pytest.raises(ConfigError) as caught:
        parse_overrides([huge])
    assert len(str(caught.value)) < 300


SPACE = {"question": "?", "base": "base.yaml"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"resources": {"hang_s": float("inf")}}, r"resources\.hang_s: Input should be a finite number"),
        ({"resources": {"hang_s": True}}, r"resources\.hang_s: .*not true"),
        ({"resources": {"gpus_per_trial": float("nan")}}, r"resources\.gpus_per_trial"),
        ({"stop": {"target": float("nan")}}, r"stop\.target: Input should be a finite number"),
        ({"stop": {"wall_time_s": True}}, r"stop\.wall_time_s: .*not true"),
        ({"scheduler": {"kind": "asha", "grace": float("nan")}}, r"scheduler\.grace"),
        ({"samples": True}, "samples: .*not true"),
        ({"seeds": True}, "seeds"),
        ({"seeds": [0, True]}, "seeds"),
        ({"parameters": {"shac.gamma": {"uniform": [0.5, float("inf")]}}}, "two numbers"),
        ({"parameters": {"shac.gamma": {"uniform": [False, True]}}}, "two numbers"),
        ({"parameters": {"shac.gamma": {"uniform": [0.1, 10**400]}}}, "two numbers"),
        ({"parameters": {"shac.gamma": {"grid": ["x" * 5000] * 10, "a": "b"}}}, "write one of grid"),
        ({"seeds": "0-199999"}, "200000 seeds"),
        ({"seeds": "0-2000,0-2000"}, "1 variants × 4002 seeds are 4002 trials, more than max_trials 2000"),
        ({"seeds": "9" * 5000}, "below 2"),
        (
            {"parameters": {f"shac.k{i}": {"grid": list(range(10))} for i in range(9)}},
            "1000000000 variants × 1 seeds are 1000000000 trials, more than max_trials 2000.* larger max_trials",
        ),
        ({"parameters": {"shac.gamma": {"uniform": [0.1, 0.9]}}, "samples": 2**31 - 1}, "more than max_trials"),
    ],
)
def test_spaces_refuse_by_one_short_line(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("env: {name: cartpole}\n")
    with pytest.raises(ConfigError, match=message) as caught:
        parse_space({**SPACE, **changes}, tmp_path / "small.yaml")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 700


def test_max_trials_allows_more(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("env: {name: cartpole}\n")
    space = parse_space({**SPACE, "seeds": "0-2999", "max_trials": 3000}, tmp_path / "small.yaml")
    assert len(space.seeds) == 3000
    assert SpaceFile.model_fields["max_trials"].default == 2000


def test_seeds_on_the_command_line_are_counted_before_they_are_made() -> None:
    with pytest.raises(ConfigError, match="2000000001 seeds, more than 100000"):
        parse_seeds("0-2000000000")


@pytest.mark.parametrize("share", [float("nan"), float("inf"), 0.0, -1.0, 1.5])
def test_a_share_of_a_gpu_is_a_number(share: float) -> None:
    with pytest.raises(ConfigError, match="--gpus-per-trial"):
        choose_placement(ResourcesSpec(), share, cpu=False, gpus=8)


def test_names_too_long_for_a_file(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    long = "n" * 300
    config = str(root / "configs" / "cartpole.yaml")
    for main, argv in (
        (train.main, ["--config", config, "--logdir", str(tmp_path / long)]),
        (train.main, ["--config", str(tmp_path / long)]),
        (tune.main, ["--space", "cartpole_smoke", "--dry-run", "--resume", "--storage", str(tmp_path), "--name", long]),
        (tune.main, ["--space", long]),
        (tune.main, ["--space", f"./{long}.yaml"]),
    ):
        assert run(main, argv) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert lines[0].startswith("error: ")
        assert len(lines[0]) < 700


def test_a_config_survives_its_own_dump() -> None:
    assert parse_config(load_config(Path(__file__).parents[2] / "configs" / "ant.yaml").as_dict())
    assert PhysicsConfig(solref=(0.02, 1.0)).solref == (0.02, 1.0)
