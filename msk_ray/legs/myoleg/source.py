"""Where a leg model comes from: a file, or a package that is installed on this machine.

Models are looked for in this order: an explicit path; the XML that myosuite 2 ships; the XML that myosuite 3 builds
through its `ModelBuilder`; the models that `myo_sim` composes. No torch: settings ask whether there is one.
"""

import importlib.util
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Final, NamedTuple

import mujoco

from msk_ray.errors import ConfigError
from msk_ray.legs.myoleg.config import PACKAGED_MODELS

INSTALL: Final = "install one with `pip install myo-sim`, or set env.model to the path of an MJCF file"
INSTALL_OF: Final = {"myosuite2": "pip install --no-deps myosuite==2.12.2", "myosuite3": "pip install myosuite"}
"""How to get the models of one package; `INSTALL` has myo_sim's."""
_V2_FILE: Final = Path("simhive/myo_sim/leg")
_V3_FILE: Final = Path("envs/myo/assets/leg/myolegs_with_torso_plane.xml")


class Source(NamedTuple):
    """Where a model comes from."""

    package: str
    """`file`, `myosuite2`, `myosuite3` or `myo_sim`."""
    version: str
    """Version of the package; empty for a file."""
    name: str
    """Name of the model, or the path of its file."""
    load: Callable[[], mujoco.MjSpec]

    def describe(self) -> str:
        """One line that names the source."""
        return f"myoleg: {self.name} from {self.package} {self.version}".rstrip()


def find_model(model: str | None, source: str = "auto") -> Source:
    """The leg model of this name or path; `myolegs` if None.

    Raises:
        ConfigError: there is no such file, name or package.
    """
    if model is not None and model not in PACKAGED_MODELS:
        path = Path(model)
        if not path.is_file():
            raise ConfigError(f"env.model: no file {model}; write a path, {' or '.join(PACKAGED_MODELS)}")
        return Source("file", "", model, lambda: spec_of_file(path))
    name = model or PACKAGED_MODELS[0]
    finders = {"myosuite2": _myosuite2, "myosuite3": _myosuite3, "myo_sim": _myo_sim}
    asked = list(finders) if source == "auto" else [source]
    for package in asked:
        found = finders[package](name)
        if found is not None:
            return found
    looked = "none of myosuite 2, myosuite 3 and myo_sim has" if source == "auto" else f"{source} is missing or lacks"
    install = INSTALL
    if source in INSTALL_OF:
        install = f"install it with `{INSTALL_OF[source]}`, or set env.source to auto to take any installed model"
    raise ConfigError(f"env.model: {looked} a model {name}; {install}")


def package_folder(name: str) -> tuple[Path, str] | None:
    """Folder and version of an installed package, without importing it."""
    found = importlib.util.find_spec(name)
    if found is None or not found.submodule_search_locations:
        return None
    try:
        version = metadata.version(name.replace("_", "-"))
    except metadata.PackageNotFoundError:
        version = "of unknown version"
    return Path(found.submodule_search_locations[0]), version


def spec_of_file(path: Path) -> mujoco.MjSpec:
    """The model in an MJCF file.

    Raises:
        ConfigError: MuJoCo cannot load it.
    """
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise ConfigError(f"env.model: MuJoCo cannot load {path}: {' '.join(str(error).split())}") from error


def _myosuite2(name: str) -> Source | None:
    package = package_folder("myosuite")
    if package is None:
        return None
    path = package[0] / _V2_FILE / f"{name}.xml"
    return Source("myosuite2", package[1], name, lambda: spec_of_file(path)) if path.is_file() else None


def _myosuite3(name: str) -> Source | None:
    package = package_folder("myosuite")
    if package is None or name != "myolegs" or not (package[0] / _V3_FILE).is_file():
        return None

    def load() -> mujoco.MjSpec:
        from myosuite.core.model_builder import ModelBuilder
        from myosuite.envs.myo.assets._resolve import resolve_leg_xml

        # The file refers to parts of myo_sim; myosuite's own resolver writes their paths into it.
        spec: mujoco.MjSpec = ModelBuilder.from_xml_file(resolve_leg_xml(_V3_FILE.name)).build_spec()
        return spec

    return Source("myosuite3", package[1], name, load)


def _myo_sim(name: str) -> Source | None:
    package = package_folder("myo_sim")
    if package is None:
        return None

    def load() -> mujoco.MjSpec:
        import myo_sim

        spec: mujoco.MjSpec = myo_sim.load_spec(name)
        return spec

    return Source("myo_sim", package[1], name, load)
