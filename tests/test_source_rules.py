"""Rules of the source that no linter here checks."""

import ast
import tomllib
from collections import Counter
from pathlib import Path


def test_mypy_ignores_no_module(root: Path) -> None:
    """Kernel modules only leave out what Warp's stubs do not know."""
    settings = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["mypy"]
    ignored = [o["module"] for o in settings["overrides"] if o.get("ignore_errors")]
    assert not ignored


def test_files_of_tests_have_names_of_their_own(root: Path) -> None:
    """pytest finds them by name alone: of two, it refuses one, but only where both are collected."""
    names = Counter(path.name for path in (root / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []


def test_nothing_is_imported_from_a_conftest(root: Path) -> None:
    """Several have that name: which one is found depends on which tests are collected first."""
    importing = [p.name for p in (root / "tests").rglob("*.py") if "\nfrom conftest import" in p.read_text()]
    assert not importing


def test_no_function_outside_kernels_has_more_than_8_parameters(root: Path) -> None:
    faults = []
    for path in (root / "msk_ray").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not _is_kernel(node):
                count = len(_parameters(node.args))
                if count > 8:
                    faults.append(f"{path.relative_to(root)}: {node.name} has {count}")
    assert not faults


def _is_kernel(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any(ast.unparse(d).startswith(("wp.kernel", "wp.func")) for d in node.decorator_list)


def _parameters(arguments: ast.arguments) -> list[str]:
    own = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    extra = [a for a in (arguments.vararg, arguments.kwarg) if a is not None]
    return [a.arg for a in (*own, *extra) if a.arg not in ("self", "cls")]
