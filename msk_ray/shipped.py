"""Files shipped with the package: the folders `configs/`, `tune_spaces/` and `policies/`.

In a checkout they are beside the package, in an installation inside it. Users give a path as in a checkout, or a name
alone. Folders of the same names in the current folder come first.
"""

from pathlib import Path

CONFIGS, SPACES, POLICIES = "configs", "tune_spaces", "policies"
_SUFFIXES = (".yaml", ".yml", ".pt")
_INSTALLED = "_data"
"""Folder of the package that holds them in an installation; see `force-include` in pyproject.toml."""


def shipped_folder() -> Path:
    """The folder that contains `configs/`, `tune_spaces/` and `policies/`."""
    package = Path(__file__).resolve().parent
    installed = package / _INSTALLED
    return installed if installed.is_dir() else package.parent


def find_shipped(name: str | Path, folder: str, suffix: str) -> Path | None:
    """The file of a path or a name; None if there is none.

    Args:
        name: a path, relative to the current folder or, below `folder`, to `shipped_folder()`; or the name of a file of
            `folder` without its suffix.
        folder: one of `CONFIGS`, `SPACES` and `POLICIES`.
        suffix: the files' suffix, such as ".yaml".
    """
    candidates = [Path(name)]
    if Path(name).parts[:1] == (folder,):
        candidates.append(shipped_folder() / name)
    if is_name(name):
        candidates += [place / f"{name}{suffix}" for place in _places(folder)]
    return next((path.resolve() for path in candidates if path.is_file()), None)


def is_name(text: str | Path) -> bool:
    """Whether a text is a file name without suffix, and not a path."""
    return Path(text).name == str(text) and Path(text).suffix not in _SUFFIXES


def shipped_names(folder: str, suffix: str) -> list[str]:
    """Names of the files of a folder, the user's and the package's, sorted."""
    return sorted({path.stem for place in _places(folder) for path in place.glob(f"*{suffix}")})


def is_shipped(path: Path) -> bool:
    """Whether a file is shipped with the package, so that nothing may be written beside it."""
    return any(path.resolve().is_relative_to(shipped_folder() / folder) for folder in (CONFIGS, SPACES, POLICIES))


def _places(folder: str) -> tuple[Path, Path]:
    return Path.cwd() / folder, shipped_folder() / folder
