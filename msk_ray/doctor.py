"""`python -m msk_ray.doctor`: can this machine run trials? If not, what needs fixing?"""

import importlib.util
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import msk_ray
from msk_ray.cli import STORAGE, Parser, run
from msk_ray.config import SET_HELP
from msk_ray.errors import ConfigError, MskRayError, StorageError
from msk_ray.files import make_folder
from msk_ray.nvidia_smi import ask_driver
from msk_ray.progress import COMPILING, announce
from msk_ray.registry import python_path

DESCRIPTION = """\
Check that this machine can run trials: versions, GPU and driver, gradients of one step, Ray, the storage folder.

Prints ok or FIX for each check. Exit code: 0 if there is nothing to fix, 1 otherwise."""

EXAMPLES = """\
  python -m msk_ray.doctor
  python -m msk_ray.doctor --device cuda:1 --storage /shared/runs
  python -m msk_ray.doctor --device cpu          # do not use the GPUs
  python -m msk_ray.doctor --repeat ant --set execution.deterministic=true      # does this trial repeat bit for bit?"""

RAY_LIMIT_S = 90.0
"""Limit on Ray's start [s]: normally seconds, but ten times as long on a busy machine with a cold disk."""
MIN_FREE_GB = 2.0
"""Rough size of a sweep's checkpoints and logs."""
GRADIENT_TOLERANCE = 1e-2
RAY_PROBE = [sys.executable, "-m", "msk_ray.tune.ray_probe"]
_SLOW_S = 0.5


@dataclass(frozen=True)
class Finding:
    """The result of a check."""

    subject: str
    text: str
    """The fact, or what to fix."""
    broken: bool = False


@dataclass(frozen=True)
class GpuFacts:
    """Facts about GPUs as reported by driver, torch and Warp."""

    driver: str | None
    """Version of the NVIDIA driver; None without one."""
    driver_gpus: int
    driver_cuda: tuple[int, int] | None
    """Highest CUDA version that the driver supports, according to Warp; None if Warp sees no driver."""
    torch_cuda: str | None
    """CUDA version torch was built with; None for a CPU build."""
    torch_gpus: int
    warp_cuda: tuple[int, int] | None
    """CUDA version Warp was built with; None for a build without CUDA."""
    warp_gpus: int
    visible: str | None
    """CUDA_VISIBLE_DEVICES."""


_NEEDED = ("torch", "warp", "mujoco", "mujoco_warp", "ray")
"""Modules that the remaining checks need."""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.doctor", DESCRIPTION, EXAMPLES)
    p.add_argument("--device", help="cpu or cuda:N (default: the first GPU, or the CPU if there is none)")
    p.add_argument("--storage", **STORAGE)
    p.add_argument(
        "--repeat", metavar="CONFIG", help="only train a trial twice, and print where the two runs begin to differ"
    )
    p.add_argument("--epochs", type=int, metavar="N", help="epochs to train with --repeat (default: 3)")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help=SET_HELP)
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    if args.repeat is not None:
        epochs = 3 if args.epochs is None else args.epochs
        return _report([Check(lambda: [check_repeat(args.repeat, args.overrides, args.device, epochs)])])
    if args.epochs is not None or args.overrides:
        raise ConfigError("--epochs and --set go with --repeat CONFIG")
    checks: list[Check] = [
        Check(check_python),
        Check(check_packages),
        Check(check_imports, needed=True),
        Check(lambda: check_gpus(args.device), "looking for GPUs"),
        Check(lambda: [check_gradient(args.device)], f"checking gradients of one step; {COMPILING}"),
        Check(lambda: [check_ray()], "starting Ray"),
        Check(lambda: [check_storage(args.storage)]),
    ]
    return _report(checks)


@dataclass(frozen=True)
class Check:
    """A check and its announcement."""

    findings: Callable[[], list[Finding]]
    beginning: str = ""
    """Line to print before a slow check."""
    needed: bool = False
    """Whether to skip the remaining checks if it has findings."""


def _report(checks: list[Check]) -> int:
    broken = 0
    for check in checks:
        if check.beginning:
            announce(check.beginning)
        # Print each line as soon as it is known: kernels may take a minute to compile.
        findings = check.findings()
        for finding in findings:
            print(f"{'FIX' if finding.broken else 'ok':5} {finding.subject:9} {finding.text}", flush=True)
            broken += finding.broken
        if check.needed and findings:
            break
    print(f"{broken} problem(s) to fix" if broken else "all checks passed")
    return 1 if broken else 0


def check_repeat(name: str, overrides: Sequence[str], device: str | None, epochs: int) -> Finding:
    """Whether a trial repeats to the last bit; if not, where it begins to differ."""
    from msk_ray.config import load_config
    from msk_ray.evaluate.measure import default_device
    from msk_ray.repeat import compare

    if epochs < 1:
        raise ConfigError(f"--epochs {epochs}: write 1 or more")
    config = load_config(name, overrides)
    if config.execution.gpus > 1:
        raise ConfigError("--repeat compares trials of one process: write --set execution.gpus=1")
    place = device or default_device()
    difference, count = compare(config, place, epochs)
    if difference is None:
        return Finding("repeat", f"{epochs} epoch(s) on {place} twice: {count} tensors are equal to the last bit")
    cure = "" if config.execution.deterministic or place == "cpu" else "; write execution.deterministic: true"
    return Finding("repeat", f"two runs on {place} differ first {difference}{cure}", True)


def check_python() -> list[Finding]:
    """Python, system and cores."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    text = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {cores} cores"
    if platform.system() != "Linux":
        return [Finding("python", f"{text}: trials are developed and tested on Linux only; use Linux or WSL 2", True)]
    return [Finding("python", text)]


def check_packages() -> list[Finding]:
    """Whether the installed packages have the versions that the project requires."""
    from packaging.requirements import Requirement

    try:
        wanted = [Requirement(text) for text in metadata.requires("msk-ray") or []]
    except metadata.PackageNotFoundError:
        return [Finding("packages", "msk-ray is not installed: run pip install -e . in its folder", True)]
    return package_findings(
        {r.name: str(r.specifier) for r in wanted if r.marker is None or r.marker.evaluate({"extra": ""})},
        {distribution.name.lower(): distribution.version for distribution in metadata.distributions()},
    )


def check_imports() -> list[Finding]:
    """Whether the modules that the remaining checks need can be imported; no finding if they can."""
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if not missing:
        return []
    return [Finding("packages", f"{', '.join(missing)} cannot be imported: nothing else was checked", True)]


def package_findings(wanted: dict[str, str], installed: dict[str, str]) -> list[Finding]:
    """One finding for all packages with a right version, and one for each other package.

    Args:
        wanted: name → version specifier.
        installed: name in lower case → version.
    """
    from packaging.specifiers import SpecifierSet

    good, bad = [], []
    for name, specifier in wanted.items():
        version = installed.get(name.lower())
        if version is None:
            bad.append(Finding("packages", f"{name} is missing: pip install '{name}{specifier}'", True))
        elif not SpecifierSet(specifier, prereleases=True).contains(version):
            bad.append(Finding("packages", f"{name} {version} does not fit: pip install '{name}{specifier}'", True))
        else:
            good.append(f"{name} {version}")
    return [*([Finding("packages", f"msk-ray {msk_ray.__version__}, {', '.join(good)}")] if good else []), *bad]


def check_gpus(device: str | None) -> list[Finding]:
    """Whether driver, torch and Warp are compatible."""
    return gpu_findings(_gpu_facts(), device)


def gpu_findings(facts: GpuFacts, device: str | None) -> list[Finding]:
    """Findings from the facts for trials on `device` (None: the first GPU)."""
    wants_gpu = device is not None and device != "cpu"
    if not facts.driver_gpus and not facts.torch_gpus and not facts.warp_gpus:
        if wants_gpu:
            return [Finding("gpu", f"no GPU found, but {device} was requested: pass --device cpu", True)]
        return [Finding("gpu", "no GPU found: trials run on CPU cores")]
    if device == "cpu":
        return [Finding("gpu", f"{facts.driver_gpus} GPU(s), not used, as requested")]
    if facts.visible is not None and not facts.visible.strip(" -1"):
        return [
            Finding(
                "gpu", f"CUDA_VISIBLE_DEVICES={facts.visible!r} hides all GPUs: unset it, or pass --device cpu", True
            )
        ]
    findings = []
    if facts.torch_cuda is None:
        findings.append(Finding("gpu", "torch is a CPU-only build: install one with CUDA from pytorch.org", True))
    elif not facts.torch_gpus:
        findings.append(Finding("gpu", _no_gpu("torch", facts.torch_cuda, facts), True))
    if facts.warp_cuda is None:
        findings.append(Finding("gpu", "Warp is a build without CUDA: pip install --force-reinstall warp-lang", True))
    elif not facts.warp_gpus or (facts.driver_cuda is not None and facts.driver_cuda[0] < facts.warp_cuda[0]):
        findings.append(Finding("gpu", _no_gpu("Warp", "{}.{}".format(*facts.warp_cuda), facts), True))
    if findings:
        return findings
    if wants_gpu and (index := _index(device)) is not None and index >= facts.torch_gpus:
        last = facts.torch_gpus - 1
        return [Finding("gpu", f"{device} was requested; the GPUs are cuda:0 to cuda:{last}: name one of them", True)]
    driver_cuda = "?" if facts.driver_cuda is None else "{}.{}".format(*facts.driver_cuda)
    return [
        Finding(
            "gpu",
            f"{facts.torch_gpus} GPU(s); driver {facts.driver or '?'} supports CUDA up to {driver_cuda}, "
            f"torch built for {facts.torch_cuda}, Warp for {'{}.{}'.format(*facts.warp_cuda or (0, 0))}",
        )
    ]


def check_gradient(device: str | None) -> Finding:
    """Gradients of one step of CartPole, compared with float64 differences of C MuJoCo."""
    from msk_ray.compiling import count_kernels
    from msk_ray.config import PhysicsConfig
    from msk_ray.envs import env_class
    from msk_ray.envs.cartpole.config import CartPoleSettings
    from msk_ray.evaluate.measure import default_device
    from msk_ray.step import Simulation, check_gradients

    where = device or default_device()
    env = CartPoleSettings(name="cartpole")
    count_kernels()
    started = time.monotonic()
    try:
        model = env_class(env).build_model(env, PhysicsConfig())
        result = check_gradients(Simulation(model, nworld=4, substeps=1, device=where))
    except (MskRayError, RuntimeError, ValueError, OSError) as error:
        # Compilers, drivers and memory allocation fail with these errors, which become the finding.
        return Finding("gradient", f"one step on {where} failed: {_one_line(error)}", True)
    seconds = time.monotonic() - started
    text = f"one step on {where}: largest relative error {result.max_rel_error:.1e} ({seconds:.0f} s with compilation)"
    if result.max_rel_error > GRADIENT_TOLERANCE:
        return Finding("gradient", f"{text}, above {GRADIENT_TOLERANCE:g}: reinstall warp-lang and mujoco-warp", True)
    return Finding("gradient", text)


def check_ray(limit_s: float = RAY_LIMIT_S) -> Finding:
    """Whether Ray starts and a worker runs a task, within `limit_s` seconds."""
    started = time.monotonic()
    # Redirect output to a file: Ray's daemons would inherit a pipe, and keep its reader waiting after the probe has
    # ended.
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(
            RAY_PROBE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONPATH": python_path()},
            start_new_session=True,
        )
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return Finding(
                "ray",
                f"did not start within {limit_s:.0f} s: look into ~/.ray/latest/session_latest/logs; "
                "a proxy, a firewall on 127.0.0.1 or a full /tmp are common causes",
                True,
            )
        output.seek(0)
        lines = output.read().strip().splitlines()
    if code != 0:
        return Finding("ray", f"does not start: {lines[-1] if lines else f'exit code {code}'}", True)
    facts = json.loads(lines[-1])
    seconds = time.monotonic() - started
    return Finding("ray", f"starts and runs a task in {seconds:.0f} s; {facts['cpus']:g} CPUs, {facts['gpus']:g} GPUs")


def check_storage(storage: Path) -> Finding:
    """Whether files can be created, flushed to disk and renamed in the storage folder."""
    folder = storage.resolve()
    try:
        with _made(folder):
            make_folder(folder)
            seconds = _write_as_a_trial_does(folder)
            free = shutil.disk_usage(folder).free / 1e9
    except StorageError as error:
        return Finding("storage", str(error), True)
    except OSError as error:
        return Finding("storage", f"{folder}: {error.strerror or error}; choose another --storage", True)
    if free < MIN_FREE_GB:
        return Finding(
            "storage", f"{folder} has {free:.1f} GB left: free some space, or choose another --storage", True
        )
    slow = f"; slow: a row of metrics takes {seconds:.1f} s to reach the disk" if seconds > _SLOW_S else ""
    return Finding("storage", f"{folder} is writable, {free:.0f} GB free{slow}")


def _write_as_a_trial_does(folder: Path) -> float:
    """Flush a file to disk and rename it; returns the time it took [s]."""
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix=".doctor", dir=folder) as scratch:
        path = Path(scratch) / "a"
        with path.open("wb") as file:
            file.write(b"0" * 4096)
            file.flush()
            os.fsync(file.fileno())
        path.replace(Path(scratch) / "b")
    return time.monotonic() - started


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Context that removes the folders created by the check."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        yield
    finally:
        for path in missing:
            if path.is_dir():
                path.rmdir()


def _gpu_facts() -> GpuFacts:
    import torch
    import warp as wp

    # This import sets Warp's log level, so that Warp does not list devices when it starts.
    import msk_ray.step.forward  # noqa: F401

    wp.init()
    view = ask_driver()
    return GpuFacts(
        view.driver,
        len(view.gpus),
        wp.get_cuda_driver_version() if wp.is_cuda_available() else None,
        torch.version.cuda,
        torch.cuda.device_count() if torch.cuda.is_available() else 0,
        wp.get_cuda_toolkit_version(),
        wp.get_cuda_device_count(),
        os.environ.get("CUDA_VISIBLE_DEVICES"),
    )


def _no_gpu(who: str, built_for: str, facts: GpuFacts) -> str:
    runs = "" if facts.driver_cuda is None else ", which supports CUDA up to {}.{}".format(*facts.driver_cuda)
    return (
        f"{who} is built for CUDA {built_for} and cannot use the GPU with driver {facts.driver or '?'}{runs}: "
        f"update the driver, or install a {who} build for an older CUDA"
    )


def _index(device: str | None) -> int | None:
    number = (device or "").partition(":")[2]
    return int(number) if number.isdecimal() else None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or repr(error)


if __name__ == "__main__":
    sys.exit(run(main))
