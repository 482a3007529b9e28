"""Shared fixtures. Worlds are few and rollouts short: everything here runs on two CPU cores.

torch is imported where it is needed: the process of pytest-xdist that hands out the tests needs none.
"""

import fcntl
import signal
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from needs import need_cpu_kernels, need_program, need_what_caused
from processes import Launcher

from msk_ray import signals
from msk_ray.config import Config, dump_yaml, load_config, parse_config
from msk_ray.experiment.manifest import Experiment
from msk_ray.sweep import opening
from msk_ray.sweep.rules.stopping import StopSpec
from msk_ray.sweep.space import Space, parse_space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.tune.finish import finish
from msk_ray.tune.trial_run import Hooks, run_trial

ROOT = Path(__file__).resolve().parent.parent
MakeSpace = Callable[..., Space]

BASE = {
    "env": {"name": "cartpole", "nworld": 8},
    "shac": {"horizon": 8},
    "evaluation": {"interval": 2},
    "trial": {"epochs": 20},
    "execution": {"checkpoint_interval": 2, "loggers": []},
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with tests of minutes, which mostly wait, come first: beside them there is room for the many short ones."""
    items.sort(key=lambda item: item.path.parent.name not in ("plugin", "tune"))


class _Module(pytest.Module):
    """A file of tests, which are skipped by name where a package is missing that the file imports."""

    def _getobj(self) -> Any:
        try:
            return super()._getobj()  # type: ignore[no-untyped-call]
        except self.CollectError as error:
            need_what_caused(error)
            raise


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    return _Module.from_parent(parent, path=module_path)


def pytest_addoption(parser: pytest.Parser, pluginmanager: pytest.PytestPluginManager) -> None:
    """A machine with a GPU may lack the plugin that ends hanging tests; its settings are known all the same."""
    if not pluginmanager.hasplugin("timeout"):
        parser.addini("timeout", "read by pytest-timeout, which is not installed")


def pytest_configure(config: pytest.Config) -> None:
    if not config.pluginmanager.hasplugin("timeout"):
        config.addinivalue_line("markers", "timeout: read by pytest-timeout, which is not installed")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    """A fixture that imports a package that is missing skips its tests by name."""
    try:
        return (yield)
    except Exception as error:
        need_what_caused(error)
        raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """So does a test."""
    try:
        return (yield)
    except Exception as error:
        need_what_caused(error)
        raise


@pytest.fixture
def root() -> Path:
    """Top folder of the repository."""
    return ROOT


@pytest.fixture(autouse=True, scope="session")
def temporary_files(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What tests, libraries and the programs that they start put into the folder for temporary files goes with the
    tests. Its path is short, because Ray's sockets lie below it, whose paths may have 107 bytes."""
    tmp_path_factory.getbasetemp()  # stays where it is: pytest keeps its last ones
    with tempfile.TemporaryDirectory(prefix="t_", ignore_cleanup_errors=True) as folder:
        before, tempfile.tempdir = tempfile.tempdir, folder
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("TMPDIR", folder)
            yield Path(folder)
        tempfile.tempdir = before


@pytest.fixture(autouse=True, scope="session")
def kernels_compile_fast_and_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Half of the time that tests of physics take is the compiler's: here it improves nothing, and of the processes
    that need the same kernels one compiles them while the others wait. Programs that tests start find them there."""
    import warp as wp
    from warp._src.context import Module

    if wp.is_cuda_available():  # its kernels are to be tested as they are used
        yield
        return
    locks = tmp_path_factory.getbasetemp().parent
    compile_it = Module._compile

    def compile_once(module: Module, *args: Any, **options: Any) -> bool:
        with (locks / f"{module.name}.lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            return compile_it(module, *args, **options)  # or finds it in the cache

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wp.config, "optimization_level", 0)
        patch.setenv("MSK_RAY_UNOPTIMIZED_KERNELS", "1")
        patch.setattr(Module, "_compile", compile_once)
        yield


@pytest.fixture(autouse=True, scope="session")
def not_ignored() -> Iterator[None]:
    """SIGHUP and SIGINT do what they do by default, also where the tests run under `nohup` or in the background of a
    shell, where programs ignore them: a shell that a test starts could not be interrupted."""
    defaults = {signal.SIGHUP: signal.SIG_DFL, signal.SIGINT: signal.default_int_handler}
    before = {number: signal.signal(number, handler) for number, handler in defaults.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def signals_as_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a program that a test runs in this process makes of signals for good ends with the test."""
    before = {number: signal.getsignal(number) for number in signals.NUMBERS}
    monkeypatch.setattr(signals, "_current", None)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Output is as wide as into a pipe: processes of pytest-xdist are told the width of the terminal they share."""
    monkeypatch.delenv("COLUMNS", raising=False)


@pytest.fixture
def launcher() -> Iterator[Launcher]:
    """Starts programs of which nothing is left after the test."""
    made = Launcher()
    yield made
    made.end()


def _tiny_settings() -> dict[str, Any]:
    return {
        "env": {"name": "cartpole", "nworld": 8, "episode_length": 40},
        "shac": {"horizon": 8, "critic_iterations": 2, "critic_batches": 2},
        "actor": {"hidden": [16, 16]},
        "critic": {"hidden": [16, 16]},
        "evaluation": {"interval": 2, "nworld": 4, "steps": 20},
        "trial": {"epochs": 6},
        "execution": {"checkpoint_interval": 2},
    }


@pytest.fixture
def tiny_settings() -> dict[str, Any]:
    """Settings of a CartPole trial of seconds, of which each test may change its own copy."""
    return _tiny_settings()


@pytest.fixture
def tiny_cartpole(tiny_settings: dict[str, Any]) -> Config:
    """A CartPole trial of seconds."""
    return parse_config(tiny_settings)


@pytest.fixture
def space_data(tmp_path: Path) -> dict[str, Any]:
    """A space of two learning rates, whose base lies in `tmp_path`."""
    (tmp_path / "base.yaml").write_text(dump_yaml(BASE))
    return {
        "question": "Which rate?",
        "base": "base.yaml",
        "parameters": {"shac.actor_lr": {"grid": [0.01, 0.001]}},
    }


@pytest.fixture
def make_space(tmp_path: Path, space_data: dict[str, Any]) -> MakeSpace:
    """Makes a space with some fields replaced."""

    def make(**changes: Any) -> Space:
        return parse_space(space_data | changes, tmp_path / "small.yaml")

    return make


@pytest.fixture(scope="session")
def cpu_kernels() -> None:
    """Physics on the CPU, also for a test that compares a GPU with it."""
    need_cpu_kernels()


@pytest.fixture(scope="session")
def sweep(cpu_kernels: None, tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """A real small sweep of CartPole, two rates by two seeds, trained here one after the other. Not to be changed."""
    from msk_ray.training import Trainer

    folder = tmp_path_factory.mktemp("sweep")
    (folder / "base.yaml").write_text(dump_yaml(_tiny_settings()))
    data = {
        "question": "Which rate?",
        "base": "base.yaml",
        "parameters": {"shac.actor_lr": {"grid": [1e-2, 1e-4]}},
        "seeds": "0-1",
    }
    space = parse_space(data, folder / "small.yaml")
    trials = resolve_trials(space)
    made = opening.create(folder / "runs" / "small", space, trials, {})
    for trial in trials:
        own = made.trial_folder(trial.id)
        own.mkdir(parents=True)
        run_trial(trial, own, "cpu", StopSpec(), Trainer, Hooks())
    assert finish(made) == 0
    return made


@pytest.fixture(scope="session")
def ant_trial(cpu_kernels: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an ant's trial of one epoch. Not to be changed."""
    from msk_ray.training import Trainer

    folder = tmp_path_factory.mktemp("ant")
    trainer = Trainer(_small_config("ant"), folder, "cpu")
    trainer.run_epoch()
    trainer.close()
    return folder


@pytest.fixture(scope="session")
def myoleg26_checkpoint(cpu_kernels: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of the leg model before any training."""
    from msk_ray.training import Trainer

    trainer = Trainer(_small_config("myoleg26_stand"), tmp_path_factory.mktemp("myoleg26"), "cpu")
    path = trainer.save()
    trainer.close()
    return path


def _small_config(name: str) -> Config:
    small = ("env.nworld=4", "shac.horizon=4", "trial.epochs=1", "actor.hidden=[16,16]", "critic.hidden=[16,16]")
    evaluation = ("evaluation.nworld=2", "evaluation.steps=40", "evaluation.interval=1")
    return load_config(ROOT / "configs" / f"{name}.yaml", [*small, *evaluation])


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium."""
    # Here, so that a GPU machine without it runs all tests that open no browser.
    from playwright.sync_api import sync_playwright

    program = need_program("chromium", "chromium-browser", "google-chrome", package="chromium")
    with sync_playwright() as playwright:
        # Its sandbox needs rights that a container, or root, does not have.
        chromium = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield chromium
        chromium.close()
