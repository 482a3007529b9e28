"""Every file in `cluster/`, against the schema of who reads it; and every key in it, misspelt, is found.

Without a cloud: Ray's check of cluster YAML, EC2's RunInstances from botocore, Kubernetes' schema of pods and
claims, shellcheck, hadolint. If the program that reads a file publishes no schema for offline use (KubeRay, Google's
machines, Grafana, Prometheus), `schemas/` holds a strict one of the fields that are set, and no other field passes.
"""

import copy
import functools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import botocore.session
import jsonschema
import kubernetes_validate
import pytest
import yaml
from botocore.validate import ParamValidator
from ray._common.utils import get_default_ray_temp_dir
from ray._private.ray_constants import PROMETHEUS_SERVICE_DISCOVERY_FILE
from ray.autoscaler._private.util import prepare_config, validate_config
from ray.scripts import scripts as ray_commands

from msk_ray.sweep.space import find_space
from msk_ray.tune.cluster import parser as cluster_parser
from msk_ray.tune.gauges import FIGURES, STATE
from msk_ray.tune.options import parser as tune_parser

FOLDER = Path(__file__).resolve().parent.parent.parent / "cluster"
KUBERNETES = "1.30"
"""The oldest release that is still looked after by all three clouds; newer ones only add fields."""

Check = Callable[[Any], None]
KeyPath = tuple[str | int, ...]


class Wrong(Exception):
    """A file does not say what its reader understands."""


def schema(name: str, part: str | None = None) -> jsonschema.Draft202012Validator:
    data = json.loads((Path(__file__).parent / "schemas" / f"{name}.json").read_text())
    return jsonschema.Draft202012Validator(data if part is None else {**data, "$ref": f"#/$defs/{part}"})


@functools.cache
def run_instances() -> Any:
    """What EC2 wants to know of a machine."""
    return botocore.session.get_session().get_service_model("ec2").operation_model("RunInstances").input_shape


def check_ray_up(config: Any) -> None:
    """A file for `ray up`."""
    validate_config(prepare_config(copy.deepcopy(config)))
    kind = config["provider"]["type"]
    schema("provider", kind).validate(config["provider"])
    for machine in config["available_node_types"].values():
        schema("provider", "resources").validate(machine["resources"])
        if kind == "aws":
            # Ray says how many.
            report = ParamValidator().validate(machine["node_config"] | {"MinCount": 1, "MaxCount": 1}, run_instances())
            if report.has_errors():
                raise Wrong(report.generate_report())
        else:
            schema("provider", "gcp_machine").validate(machine["node_config"])
    for local in config["file_mounts"].values():
        if not local.startswith("~") and not (FOLDER.parent / local).exists():
            raise Wrong(f"file_mounts: {local} is not there")


def check_manifest(manifest: Any) -> None:
    """One document of a file for kubectl."""
    if manifest.get("kind") == "PersistentVolumeClaim":
        kubernetes_validate.validate(manifest, KUBERNETES, strict=True)
        check_quantities(manifest["spec"]["resources"], {"storage"})
        return
    schema("kuberay").validate(manifest)
    cluster = manifest["spec"].get("rayClusterSpec", manifest["spec"])
    groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
    for group in groups:
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "x"}, "spec": group["template"]["spec"]}
        kubernetes_validate.validate(pod, KUBERNETES, strict=True)
        check_start("ray start " + " ".join(f"--{key}={value}" for key, value in group["rayStartParams"].items()))
        for container in group["template"]["spec"]["containers"]:
            check_quantities(container["resources"], {"cpu", "memory", "nvidia.com/gpu"})


def check_quantities(resources: Any, known: set[str]) -> None:
    """Names of resources, which Kubernetes' schema leaves open."""
    for quantities in resources.values():
        if set(quantities) - known:
            raise Wrong(f"resources: {set(quantities) - known}")


def check_start(command: str) -> None:
    """The options of one `ray start`, as Ray itself reads them."""
    words = shlex.split(command)
    ray_commands.start.make_context("start", words[words.index("start") + 1 :])


def check_json(name: str) -> Check:
    return lambda data: schema(name).validate(data)


def documents() -> Iterator[tuple[str, Any, Check]]:
    """Every document of every YAML and JSON file, with what checks it."""
    for name in ("aws", "gcp"):
        yield name, yaml.safe_load((FOLDER / f"{name}.yaml").read_text()), check_ray_up
    for name in ("raycluster", "rayjob"):
        for document in yaml.safe_load_all((FOLDER / f"{name}.yaml").read_text()):
            yield f"{name} {document['kind']}", document, check_manifest
    grafana = FOLDER / "grafana"
    yield "dashboard", json.loads((grafana / "dashboards" / "msk_ray.json").read_text()), check_json("dashboard")
    for part, name in (("dashboards", "provider"), ("datasources", "prometheus")):
        yield name, yaml.safe_load((grafana / part / f"{name}.yaml").read_text()), check_json(f"grafana_{part}")
    yield "scraping", yaml.safe_load((FOLDER / "prometheus.yml").read_text()), check_json("prometheus")


DOCUMENTS = list(documents())
FREE = {
    "aws": [("available_node_types", "*"), ("file_mounts", "*")],
    "gcp": [("available_node_types", "*"), ("file_mounts", "*")],
    "dashboard": [("panels", "*", "transformations", "*", "options", "excludeByName", "*")],
}
"""Keys that are names of our own: any other would do as well. What refers to them is checked elsewhere."""


@pytest.mark.parametrize(("document", "check"), [d[1:] for d in DOCUMENTS], ids=[d[0] for d in DOCUMENTS])
def test_document(document: Any, check: Check) -> None:
    check(document)


@pytest.mark.long
@pytest.mark.parametrize(("name", "document", "check"), DOCUMENTS, ids=[d[0] for d in DOCUMENTS])
def test_every_key_misspelt_is_found(name: str, document: Any, check: Check) -> None:
    places = [place for place in keys(document) if not any(matches(place, free) for free in FREE.get(name, []))]
    assert len(places) > 5
    unnoticed = [place for place in places if passes(check, misspelt(document, place))]
    assert not unnoticed


def passes(check: Check, document: Any) -> bool:
    try:
        check(document)
    except Exception:
        # Each reader has exceptions of its own, and some stumble over a key that is missing.
        return False
    return True


def keys(node: Any, above: KeyPath = ()) -> Iterator[KeyPath]:
    """Where every key of nested mappings is."""
    for key, child in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        if isinstance(node, dict):
            yield (*above, key)
        yield from keys(child, (*above, key))


def matches(place: KeyPath, pattern: tuple[str, ...]) -> bool:
    return len(place) == len(pattern) and all(p in ("*", key) for key, p in zip(place, pattern, strict=True))


def misspelt(document: Any, place: KeyPath) -> Any:
    """A copy with two letters of one key swapped."""
    # Not deepcopy: YAML's aliases would change everywhere.
    changed = json.loads(json.dumps(document))
    node = changed
    for part in place[:-1]:
        node = node[part]
    key = str(place[-1])
    swapped = next(
        (key[:i] + key[i + 1] + key[i] + key[i + 2 :] for i in range(len(key) - 1) if key[i] != key[i + 1]), key + "s"
    )
    node[swapped] = node.pop(place[-1])
    return changed


def test_names_that_files_give_are_those_they_use() -> None:
    for name in ("aws", "gcp"):
        config = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
        workers = sum(kind.get("min_workers", 0) for kind in config["available_node_types"].values())
        assert workers == config["max_workers"]
        assert set(config["file_mounts"]) >= {"/home/ubuntu/.ray/auth_token", "/home/ubuntu/msk_ray/msk_ray"}
    for name in ("raycluster", "rayjob"):
        claim, manifest = yaml.safe_load_all((FOLDER / f"{name}.yaml").read_text())
        cluster = manifest["spec"].get("rayClusterSpec", manifest["spec"])
        for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
            spec = group["template"]["spec"]
            volumes = {volume["name"]: volume for volume in spec["volumes"]}
            assert volumes["runs"]["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]
            for container in spec["containers"]:
                assert {mount["name"] for mount in container["volumeMounts"]} == set(volumes)
        pinned = re.search(r"^ray==(.+)$", (FOLDER.parent / "constraints.txt").read_text(), re.M)
        assert pinned
        assert cluster["rayVersion"] == pinned[1]


def test_the_dashboard_asks_for_gauges_there_are() -> None:
    dashboard = json.loads((FOLDER / "grafana" / "dashboards" / "msk_ray.json").read_text())
    asked = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    asked += [variable["query"] for variable in dashboard["templating"]["list"]]
    used = {name for text in asked for name in re.findall(r"ray_\w+", text)}
    assert used == {f"ray_{name}" for name in (*FIGURES, STATE)}


def test_prometheus_finds_the_nodes_where_ray_lists_them(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RAY_TMPDIR", "TMPDIR"):
        monkeypatch.delenv(name, raising=False)
    (job,) = yaml.safe_load((FOLDER / "prometheus.yml").read_text())["scrape_configs"]
    (found,) = job["file_sd_configs"]
    assert found["files"] == [str(Path(get_default_ray_temp_dir()) / PROMETHEUS_SERVICE_DISCOVERY_FILE)]


def shell_of(config: Any) -> str:
    """All commands of a file for `ray up`, one a line."""
    parts = [
        "setup_commands",
        "head_setup_commands",
        "worker_setup_commands",
        "head_start_ray_commands",
        "worker_start_ray_commands",
    ]
    return "\n".join(command for part in parts for command in config[part])


@pytest.mark.parametrize("name", ["aws", "gcp"])
def test_commands_that_nodes_run(name: str, tmp_path: Path) -> None:
    text = shell_of(yaml.safe_load((FOLDER / f"{name}.yaml").read_text()))
    script = tmp_path / "commands.sh"
    # One command writes $PATH into a file, to be expanded there.
    script.write_text('#!/usr/bin/env bash\n# shellcheck disable=SC2016\n{\n: "${RAY_HEAD_IP:?}"\n' + text + "\n}\n")
    assert shellcheck(script) == ""
    starts = re.findall(r"ray start[^;\n]*", text)
    assert len(starts) == 2
    for start in starts:
        check_start(start)
    assert "RAY_AUTH_MODE=token" in text
    assert "0.0.0.0" not in text
    with pytest.raises(ray_commands.click.NoSuchOption):
        check_start(starts[0].replace("--port", "--prot"))


METADATA = {
    "http://169.254.169.254/latest/api/token": "secret",
    "http://169.254.169.254/latest/meta-data/mac": "02:29:96:8f:6a:2d",
    "http://169.254.169.254/latest/meta-data/network/interfaces/macs/02:29:96:8f:6a:2d/vpc-ipv4-cidr-blocks": (
        "172.31.0.0/16\n10.7.0.0/20"
    ),
    "http://metadata.google.internal/computeMetadata/v1/instance/network-interfaces/0/ip": "10.128.3.9",
    "http://metadata.google.internal/computeMetadata/v1/instance/network-interfaces/0/subnetmask": "255.255.240.0",
}
"""What machines are told about themselves on AWS (instance metadata, version 2) and Google Cloud."""


@pytest.mark.parametrize(("name", "networks"), [("aws", ["172.31.0.0/16", "10.7.0.0/20"]), ("gcp", ["10.128.0.0/20"])])
def test_the_storage_is_shared_with_the_clusters_network_alone(name: str, networks: list[str], tmp_path: Path) -> None:
    commands = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())["head_setup_commands"]
    (command,) = [command for command in commands if "exportfs" in command]
    exports = tmp_path / "exports"
    answers = "\n".join(f"{url}) printf '{text}' ;;" for url, text in METADATA.items())
    fakes = {
        "curl": f'case "${{!#}}" in\n{answers}\n*) exit 22 ;;\nesac',
        "sudo": f'case "$1" in tee) cat > {exports} ;; exportfs) ;; *) exit 1 ;; esac',
    }
    for fake, body in fakes.items():
        (tmp_path / fake).write_text(f"#!/bin/bash\n{body}\n")
        (tmp_path / fake).chmod(0o755)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    subprocess.run(["bash", "-c", command], env=environment, check=True)
    assert exports.read_text().splitlines() == [f"/shared {net}(rw,sync,no_subtree_check)" for net in networks]
    exports.unlink()
    (tmp_path / "curl").write_text("#!/bin/bash\nexit 22\n")  # no answer
    assert subprocess.run(["bash", "-c", command], env=environment).returncode != 0
    assert not exports.exists()


def test_commands_that_start_experiments() -> None:
    readme = (FOLDER / "README.md").read_text()
    text = readme + (FOLDER / "rayjob.yaml").read_text() + (FOLDER / "slurm.sbatch").read_text()
    calls = re.findall(r"start_or_resume\.sh ([\w.-]+) (/\S+)((?: --?[\w.=-]+(?: [\w.:]+)?)*)", text)
    assert len(calls) >= 4
    for space, storage, options in calls:
        find_space(space)
        tune_parser().parse_args(["--space", space, "--storage", storage, *options.split()])
    waits = re.findall(r"msk_ray\.tune\.cluster((?: --\w+ [\w.]+)+)", readme)
    assert len(waits) >= 2
    for options in waits:
        cluster_parser().parse_args(options.split())


def shellcheck(script: Path) -> str:
    result = subprocess.run(
        [Path(sys.executable).with_name("shellcheck"), "--shell=bash", "--external-sources", "--format=gcc", script],
        capture_output=True,
        text=True,
    )
    return result.stdout + result.stderr


SCRIPTS = {
    "slurm.sbatch": "start_limit",
    "slurm_node.sh": "code",
    "start_or_resume.sh": "code",
    "stop_signals.sh": "turn",
}
"""A variable of each, which it uses and sets."""


@pytest.mark.parametrize(("name", "variable"), SCRIPTS.items())
def test_scripts(name: str, variable: str, tmp_path: Path) -> None:
    shutil.copytree(FOLDER, tmp_path, dirs_exist_ok=True)  # a script that sources another finds it
    script = tmp_path / name
    assert shellcheck(script) == ""
    text = script.read_text()
    # Where a variable is set from outside, the directive that says so covers the whole file.
    alone = text.replace("disable=SC2154", "disable=SC2153")
    script.write_text(re.sub(rf"\b{variable}\b(?!=)", f"{variable}s", alone))
    assert "SC2154" in shellcheck(script)  # referenced and never assigned
    script.write_text(re.sub(r"^( *)(while|if) ", r"\1fi ", text, count=1, flags=re.M))
    assert "error" in shellcheck(script)


SBATCH = {
    "job-name",
    "output",
    "open-mode",
    "nodes",
    "ntasks-per-node",
    "cpus-per-task",
    "gpus-per-node",
    "time",
    "signal",
    "requeue",
}
"""Options of sbatch (its manual, 22.05) that the script sets."""


def test_options_of_sbatch() -> None:
    lines = [line for line in (FOLDER / "slurm.sbatch").read_text().splitlines() if line.startswith("#SBATCH")]
    assert {re.fullmatch(r"#SBATCH --([a-z-]+)(=\S+)?", line)[1] for line in lines} == SBATCH  # type: ignore[index]


def hadolint(text: str) -> str:
    result = subprocess.run(
        [Path(sys.executable).with_name("hadolint"), "--no-color", "-"], input=text, capture_output=True, text=True
    )
    return result.stdout + result.stderr


def test_dockerfile() -> None:
    text = (FOLDER / "Dockerfile").read_text()
    assert hadolint(text) == ""
    for instruction in sorted(set(re.findall(r"^([A-Z]+) ", text, re.M))):
        assert hadolint(re.sub(rf"^{instruction} ", f"{instruction}X ", text, count=1, flags=re.M)), instruction
    copied = [word for line in re.findall(r"^COPY (.*)$", text, re.M) for word in line.split()[:-1]]
    ignored = (FOLDER.parent / ".dockerignore").read_text().splitlines()
    for path in copied:
        assert (FOLDER.parent / path).exists(), path
        assert f"!{path}" in ignored
    assert "0.0.0.0" not in text


def test_every_file_is_checked_here() -> None:
    found = {path.name for path in FOLDER.rglob("*") if path.is_file()}
    checked = {"aws.yaml", "gcp.yaml", "raycluster.yaml", "rayjob.yaml", "Dockerfile", *SCRIPTS}
    assert found == checked | {"msk_ray.json", "provider.yaml", "prometheus.yaml", "prometheus.yml", "README.md"}
