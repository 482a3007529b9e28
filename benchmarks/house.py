"""How large the house is: lines of each room, settings, words, and what an extension touches, for any checkout.

    python benchmarks/house.py                      # this checkout
    python benchmarks/house.py ../before . --write  # two of them side by side, appended to results/house.md
    python benchmarks/house.py --never              # names the settings that nothing shipped sets

*Lines* are those of Python files: a line is blank, a comment, part of a docstring (of a module, class, function or
attribute), or code. *Settings* are the leaves of the config with every environment and algorithm of the package, and of
a space file, counted once where they are declared. One is *set* if a config, a space, an example or a page of the
manual gives it a value. *Words* stand between blanks and have a letter or digit. *Edits of an extension* are the places
in existing files that a new one of its kind has to change, and *files from ctrl to kernel* those that the path of a
control goes through: both are lists of patterns below, each of which is looked for in the checkout, wherever it may be.
"""

import argparse
import ast
import datetime
import io
import json
import os
import re
import shlex
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

import yaml
from record import RESULTS, markdown_table

ROOMS = ("step", "runner", "legs", "robots")
"""Folders of `msk_ray/`; the runner's are all that have no other room."""

EDITS: dict[str, tuple[str, ...]] = {
    "environment": (r"^ENVIRONMENTS = Registry", r"^SETTINGS = Registry"),
    "algorithm": (r"^ALGORITHMS = Registry", r"^BUILT_IN\b", r"^    ppo: PpoConfig", r"import PpoConfig as PpoConfig"),
    "reward term of the legs": (r'^    Cost\("footfall", 0\.0, needs', r"^def footfall\(env: LegEnv"),
    "physics feature": (
        *(r'^    Feature\("drag of a fluid', r"^    if work\.settings\.fluid", r"^    fluid_on: bool$"),
        r"^            fluid_on=bool\(mjm",
    ),
    "actuator type": (
        *(r"^def free_activation\(", r"^def actuator_force\(", r"^def force_velocity_slope\(", r"^def act_step\("),
        *(r"^def _foreign_actuator\(", r'^        "actuators: motor, position', r"^def _depends_on_velocity\("),
    ),
    "parameter of the model": (r"^PARAMETERS: dict", r"^class RandomizeConfig", r'^    "pair_friction": _Field'),
    "search": (r"^SEARCHES = Registry",),
    "scheduler": (r"^SCHEDULERS = Registry",),
    "operator": (r"^OPERATORS = Registry",),
    "stop rule": (r"^class StopSpec",),
    "logger": (r"^LOGGERS = Registry",),
    "exporter": (r"^FORMATS = ",),
    "command": (r"^COMMANDS = ",),
    "setting of the physics": (r"^class PhysicsConfig", r"^SOLVING = ", r"^def _unread\("),
}
"""Places in existing files that one more of each kind has to change. One that appears as the code changes has to be
added here."""

FROM_CTRL_TO_KERNEL = (
    *(r"^class WarpSimStep\(", r"^class Stepper\b", r"^class Engine\b", r"^class BatchTensors\b", r"^class Graph\b"),
    *(r"^class TapePerSubstep\b", r"^class WorldBatch\b", r"^class Stages\b", r"^def (recomputed|substep_pullback)\("),
    *(r"^class StepAdjoint\b", r"^ *def pull_actuators\("),
)
"""What the path of a control's tensor goes through, to the kernel of actuators and back."""

TRIAL, SPACE = "trial", "space"
_INLINE = re.compile(r"`([a-z_]+(?:\.[a-z_0-9]+)*)(?:=|: )([^`]+)`")
_SET = re.compile(r"--set[ =]'?\"?([a-z_]+(?:\.[a-z_0-9]+)*)=(.*?)(?=\s--|\s#|$)", re.MULTILINE)


def room_of(path: Path, package: Path) -> str:
    """The room of a file of the package."""
    folder = path.relative_to(package).parts[0]
    return folder if folder in ROOMS else "runner"


def lines_of(path: Path) -> Counter[str]:
    """How many lines of a Python file are code, docstring, comment and blank."""
    text = path.read_text(encoding="utf-8")
    kinds = ["blank" if not line.strip() else "code" for line in text.splitlines()]
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and not token.line[: token.start[1]].strip():
            kinds[token.start[0] - 1] = "comments"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            for line in range(node.lineno - 1, node.end_lineno or node.lineno):
                kinds[line] = "docstrings"
    return Counter(kinds)


def rooms(checkout: Path) -> dict[str, Counter[str]]:
    """Lines by room; tests, benchmarks and the lab are rooms of their own."""
    lines: dict[str, Counter[str]] = {room: Counter() for room in ROOMS}
    for path in sorted((checkout / "msk_ray").rglob("*.py")):
        lines[room_of(path, checkout / "msk_ray")] += lines_of(path)
    for name in ("tests", "benchmarks", "lab"):
        lines[name] = sum((lines_of(path) for path in sorted((checkout / name).rglob("*.py"))), Counter())
    return lines


def models_in(annotation: Any) -> tuple[list[tuple[type, str]], bool]:
    """The sections in a setting's type, each with what stands between their names (".*" in a mapping), and whether the
    setting may also be a plain value."""
    from pydantic import BaseModel

    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [(annotation, "")], False
    parts = [part for part in get_args(annotation) if part is not type(None)]
    origin = get_origin(annotation)
    if isinstance(origin, type) and issubclass(origin, dict):
        return [(model, ".*" + between) for model, between in models_in(parts[-1])[0]], False
    if annotation is type(None) or not parts or origin in (tuple, list):
        return [], True
    if hasattr(annotation, "__metadata__"):
        parts = [annotation.__origin__]
    inner = [models_in(part) for part in parts]
    return [model for models, _ in inner for model in models], any(plain for _, plain in inner)


def walk(model: type, prefix: str) -> Iterator[tuple[str, str]]:
    """(dotted key, class and name of its declaration) of every setting below a section."""
    for name, field in model.model_fields.items():
        key = f"{prefix}.{name}" if prefix else name
        models, plain = models_in(field.annotation)
        if plain or not models:
            owner = next(c for c in reversed(model.__mro__) if name in getattr(c, "__annotations__", {}))
            yield key, f"{owner.__qualname__}.{name}"
        for inner, between in models:
            if len(inner.model_fields) == 1:  # and may be written as its one value
                yield key, f"{inner.__qualname__}.{name}"
            else:
                yield from walk(inner, key + between)


def declared(checkout: Path) -> dict[str, list[tuple[str, str]]]:
    """The settings that the checkout on `sys.path` declares, for trials and for spaces, as `walk` gives them."""
    from importlib import import_module

    from msk_ray.config import environments
    from msk_ray.config.schema import Config
    from msk_ray.sweep import rules
    from msk_ray.sweep.space import SpaceFile, scheduler_class

    def at(path: str) -> Any:
        module, _, name = path.partition(":")
        return getattr(import_module(module), name)

    project = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]
    entries = project.get("entry-points", {})
    outside = {**entries.get("msk_ray.envs", {}), **entries.get("msk_ray.env_settings", {})}
    inside = {name: environments.settings_class(name) for name in environments.ENVIRONMENTS.known()}
    settings = inside | {name: getattr(at(path), "Settings", at(path)) for name, path in outside.items()}
    trial = {entry for section in settings.values() for entry in walk(section, "env")}
    trial |= {entry for entry in walk(Config, "") if not entry[0].startswith("env.")}
    kinds = {name: scheduler_class(name) for name in rules.SCHEDULERS.known()}
    space = {entry for entry in walk(SpaceFile, "") if not entry[0].startswith("scheduler")}
    space |= {entry for section in kinds.values() for entry in walk(section, "scheduler")}
    return {TRIAL: sorted(trial), SPACE: sorted(space)}


def flat(values: Any, prefix: str = "") -> Iterator[str]:
    """Dotted keys of the leaves of nested settings, whose own keys may be dotted."""
    if not isinstance(values, dict):
        yield prefix
        return
    for key, value in values.items():
        yield from flat(value, f"{prefix}.{key}" if prefix else str(key))


def set_by_space(data: dict[str, Any]) -> dict[str, set[str]]:
    """What a space file sets: of its trials, and of its own."""
    ablate, smoke = data.get("ablate") or {}, data.get("smoke") or {}
    trial = set(flat(data.get("overrides") or {})) | set(flat(smoke.get("overrides") or {}))
    for part in (ablate.get("baseline") or {}, *(ablate.get("variants") or {}).values()):
        trial |= set(flat(part))
    for key, operator in (data.get("parameters") or {}).items():
        for values in operator.values():
            for value in values if isinstance(values, list) else [values]:
                trial |= set(flat(value.get("value", value) if isinstance(value, dict) else value, key))
    own = {key: value for key, value in data.items() if key not in ("overrides", "parameters", "ablate", "smoke")}
    own_keys = set(flat(own)) | {key for key in ("overrides", "parameters") if key in data}
    own_keys |= {f"ablate.{key}" for key in ablate} | {f"smoke.{key}" for key in smoke}
    return {TRIAL: trial, SPACE: own_keys}


def yaml_of(text: str) -> Any:
    """What YAML makes of a piece of text; of what is none, nothing."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return None


def set_by_pages(checkout: Path) -> dict[str, set[str]]:
    """What examples, and the commands, blocks of YAML and inline code of the pages that users read, give a value."""
    pages = [checkout / "README.md", *(checkout / "policies").glob("*.md"), *(checkout / "docs").rglob("*.md")]
    keys_of: dict[str, set[str]] = {TRIAL: set(), SPACE: set()}
    texts = [path.read_text() for path in [*pages, *(checkout / "docs").rglob("*.py")]]
    blocks = [block for text in texts for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)]
    for block in [*blocks, *(path.read_text() for path in (checkout / "docs" / "examples").glob("*.yaml"))]:
        data = yaml.safe_load(block)
        if isinstance(data, dict) and "base" in data:
            keys_of = {kind: keys_of[kind] | keys for kind, keys in set_by_space(data).items()}
        else:
            # A block may show a part of a config, or of a space.
            keys_of = {kind: keys | set(flat(data)) for kind, keys in keys_of.items()}
    for text in texts:
        for key, value in _INLINE.findall(text):
            inside = yaml_of(value)
            for keys in keys_of.values():
                keys |= set(flat(inside, key)) if isinstance(inside, dict) else {key}
        options = {name.replace("-", "_") for name in re.findall(r"(?<=\s)--([a-z-]+)", text)}
        keys_of[SPACE] |= {f"resources.{name}" for name in options}
        keys_of[TRIAL] |= {f"trial.{name}" for name in options}
        for key, value in _SET.findall(text.replace("\\\n", " ")):
            keys_of[TRIAL] |= {key, *(f"{key}.{name}" for name in re.findall(r"[{,]\s*([a-z_]+):", value))}
    return keys_of


def settings_of(checkout: Path) -> dict[str, Any]:
    """How many settings there are, who sets them, and the names of those that nobody does."""
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    command = [sys.executable, str(Path(__file__).resolve()), "--declared", str(checkout)]
    done = subprocess.run(command, env=environment, cwd=checkout, check=True, capture_output=True, text=True)
    known = json.loads(done.stdout)
    configs: set[str] = set()
    for path in (checkout / "configs").rglob("*.yaml"):
        configs |= set(flat(yaml.safe_load(path.read_text())))
    spaces = [set_by_space(yaml.safe_load(path.read_text())) for path in (checkout / "tune_spaces").glob("*.yaml")]
    pages = set_by_pages(checkout)
    counts: Counter[str] = Counter()
    never = []
    for kind, entries in known.items():
        by_spaces = {key for space in spaces for key in space[kind]}
        keys_of: dict[str, list[str]] = {}
        for key, owner in entries:
            keys_of.setdefault(owner, []).append(re.escape(key).replace(r"\*", "[^.]+"))
        for owner, keys in keys_of.items():
            pattern = re.compile(f"({'|'.join(keys)})" + r"(\..*)?")

            def sets(keys: set[str], pattern: re.Pattern[str] = pattern) -> bool:
                return any(pattern.fullmatch(other) for other in keys)

            counts[kind] += 1
            if kind == TRIAL and sets(configs):
                counts["set by a config"] += 1
            elif sets(by_spaces):
                counts["set by spaces only"] += 1
            elif sets(pages[kind]):
                counts["set by the manual or an example only"] += 1
            else:
                never.append(owner)
    return {"counts": counts, "never": never}


def places(checkout: Path, patterns: tuple[str, ...]) -> list[str]:
    """Files of the package in which the patterns are found, one for each pattern that is."""
    texts = {path: path.read_text() for path in sorted((checkout / "msk_ray").rglob("*.py"))}
    paths = [next((p for p, text in texts.items() if re.search(each, text, re.MULTILINE)), None) for each in patterns]
    return [str(path.relative_to(checkout / "msk_ray")) for path in paths if path is not None]


def words(paths: list[Path]) -> int:
    """Words of files: what stands between blanks and has a letter or digit."""
    return sum(len(re.findall(r"\S*\w\S*", path.read_text(encoding="utf-8"))) for path in paths)


def measures(checkout: Path) -> tuple[dict[str, str], list[str]]:
    """Every measure of a checkout by its name, and the settings that nobody sets."""
    figures: dict[str, str] = {}
    kinds = ("code", "docstrings", "comments", "blank")
    counted = rooms(checkout)
    for room, lines in {**counted, "msk_ray": sum((counted[room] for room in ROOMS), Counter())}.items():
        each = " + ".join(f"{lines[kind]:,}" for kind in kinds)
        figures[f"lines of {room}: code + docstrings + comments + blank"] = f"{sum(lines.values()):,} = {each}"
    settings = settings_of(checkout)
    counts = settings["counts"]
    figures["settings: of a trial + of a space"] = f"{counts[TRIAL]} + {counts[SPACE]}"
    for name in ("set by a config", "set by spaces only", "set by the manual or an example only"):
        figures[f"settings {name}"] = str(counts[name])
    figures["settings that nothing shipped sets"] = str(len(settings["never"]))
    for name in ("configs", "tune_spaces", "benchmarks"):
        suffix = "*.py" if name == "benchmarks" else "*.yaml"
        paths = (checkout / name).glob(suffix) if name == "benchmarks" else (checkout / name).rglob(suffix)
        figures[f"files of {name}/"] = str(len(list(paths)))
    figures["words of README.md"] = f"{words([checkout / 'README.md']):,}"
    figures["words of the manual, docs/"] = f"{words(list((checkout / 'docs').rglob('*.md'))):,}"
    figures["words of lab/"] = f"{words(list((checkout / 'lab').glob('*.md'))):,}"
    for name, patterns in EDITS.items():
        at = places(checkout, patterns)
        files = len(set(at))
        figures[f"edits for a further {name}"] = f"{len(at)} in {files} file{'s' * (files != 1)}"
    path = places(checkout, FROM_CTRL_TO_KERNEL)
    figures["files from ctrl to a kernel and back"] = str(len(set(path)))
    return figures, settings["never"]


def commit_of(checkout: Path) -> str:
    run = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--exclude=*"]
    return subprocess.run(run, check=True, capture_output=True, text=True).stdout.strip()


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("checkouts", nargs="*", type=Path, default=[Path(__file__).parents[1]])
    p.add_argument("--never", action="store_true", help="name the settings that nothing shipped sets")
    p.add_argument("--write", action="store_true", help="append the table to results/house.md")
    p.add_argument("--declared", type=Path, metavar="CHECKOUT", help=argparse.SUPPRESS)
    args = p.parse_args()
    if args.declared is not None:
        print(json.dumps(declared(args.declared)))
        return
    trees = [tree.resolve() for tree in args.checkouts]
    measured = [measures(tree) for tree in trees]
    rows = [[name, *(figures.get(name, "") for figures, _ in measured)] for name in measured[-1][0]]
    table = markdown_table(["", *map(commit_of, trees)], rows)
    command = f"python {' '.join(map(shlex.quote, sys.argv))}"
    text = f"## The house\n\n{datetime.datetime.now(datetime.UTC).date()}\n\n`{command}`\n\n{table}\n"
    if args.never:
        text += "\nNothing sets, in the last column: " + ", ".join(f"`{name}`" for name in measured[-1][1]) + ".\n"
    print(text)
    if args.write:
        with (RESULTS / "house.md").open("a", encoding="utf-8") as file:
            file.write(text + "\n")


if __name__ == "__main__":
    main()
