"""`python -m msk_ray.gradcheck MODEL.xml`: is the gradient of this model right?"""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msk_ray.cli import Parser, run
from msk_ray.compiling import announce_compiling
from msk_ray.errors import ConfigError, UnsupportedModelError
from msk_ray.progress import Pace

if TYPE_CHECKING:
    import mujoco

    from msk_ray.step.check.check import GradientCheck

DESCRIPTION = """\
Check gradients of an env step of MODEL.xml against float64 central differences of C MuJoCo.

Every state gets a random cotangent on (qpos', qvel', act') after --substeps physics steps; the gradients with respect
to ctrl, qpos, qvel, act and --parameters are compared in tangent space. States where the step has a kink, and states
where the Warp forward pass itself differs from C MuJoCo, are left out and counted.

  rel_error   |g - g_ref| / |g_ref|    0 is right
  cosine      between g and g_ref      1 is right; separates direction from magnitude
  norm_ratio  |g| / |g_ref|            1 is right; far above 1 means exploding gradients

A step or a gradient that is not finite, at any state, fails the check; its elements are named.

Exit code: 0 within the tolerance, 1 above it, 2 for an unsupported model or a wrong command line."""

EXAMPLES = """\
  python -m msk_ray.gradcheck my_robot.xml
  python -m msk_ray.gradcheck my_robot.xml --substeps 16 --states standing,contact --worlds 20 --tolerance 1e-2
  python -m msk_ray.gradcheck my_robot.xml --mode fd_jacobian --tolerance 5e-2    # a model the adjoint refuses
  python -m msk_ray.gradcheck configs/ant.yaml --substeps 4 --states contact
  python -m msk_ray.gradcheck my_robot.xml --parameters body_mass,geom_friction --states contact
  python -m msk_ray.gradcheck my_robot.xml --json > gradients.json"""

MANY_EXCLUDED = 0.25
"""Share of excluded states above which a note follows the table."""


def _positive(kind: type) -> Any:
    def parse(text: str) -> Any:
        value = kind(text)
        if not (value > 0 and math.isfinite(value)):
            raise argparse.ArgumentTypeError(f"must be above zero, not {text}")
        return value

    parse.__name__ = kind.__name__  # argparse shows this name if the text is not a number
    return parse


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.gradcheck", DESCRIPTION, EXAMPLES)
    p.add_argument(
        "model",
        type=Path,
        metavar="MODEL.xml",
        help="an MJCF or URDF file, a compiled .mjb, or a trial's .yaml, for the model that it trains",
    )
    p.add_argument(
        "--mode",
        default="tape_per_substep",
        metavar="MODE",
        help="backward mode (default: %(default)s); fd_jacobian works with any model; an unknown name lists all modes",
    )
    p.add_argument(
        "--integrator",
        choices=("Euler", "implicitfast", "RK4"),
        help="use this integrator instead of the model's own",
    )
    p.add_argument("--substeps", type=_positive(int), default=1, metavar="N", help="physics steps (default: 1)")
    p.add_argument(
        "--states",
        default="standing,random",
        metavar="KINDS",
        help="comma-separated: standing, random, contact (in contact during rollouts under random controls; any state "
        "if nothing ever touches), policy (along a smooth rollout) (default: %(default)s)",
    )
    p.add_argument(
        "--parameters",
        default="",
        metavar="NAMES",
        help="also compare gradients of these model fields, comma-separated, such as body_mass,opt.gravity; "
        "all: every field that the model has (default: none)",
    )
    p.add_argument("--worlds", type=_positive(int), default=8, metavar="W", help="states of each kind (default: 8)")
    p.add_argument(
        "--tolerance", type=_positive(float), default=1e-2, metavar="T", help="largest rel_error (default: %(default)s)"
    )
    p.add_argument("--seed", type=int, default=0, help="seed of states and cotangents (default: 0)")
    p.add_argument("--device", default="cpu", help="cpu or cuda:N (default: cpu)")
    p.add_argument(
        "--solver-tolerance",
        type=_positive(float),
        metavar="T",
        help="tolerance of Warp's solver (default: the model's)",
    )
    for option, what in (
        ("--iterations", "iterations of Warp's solver"),
        ("--ls-iterations", "those of a line search"),
    ):
        p.add_argument(
            option,
            type=_positive(int),
            metavar="N",
            help=f"most {what} (default: the model's, at least {'50' if 'ls' in option else '100'}; a trial's .yaml: "
            "the trial's)",
        )
    p.add_argument(
        "--forward-tolerance",
        type=_positive(float),
        metavar="T",
        help="forward mismatch above which a state is left out, relative to its motion (default: 3e-5)",
    )
    p.add_argument(
        "--nconmax",
        type=_positive(int),
        metavar="N",
        help="contacts per world (default: from a short probe, grows when needed)",
    )
    p.add_argument("--njmax", type=_positive(int), metavar="N", help="constraint rows per world (default: likewise)")
    p.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    return p


def _listed(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def load_model(path: Path) -> "tuple[mujoco.MjModel, dict[str, int]]":
    """Compile a model file; also returns the solver's iteration limits, for a trial's config.

    Raises:
        ConfigError: MuJoCo cannot load it.
    """
    import mujoco

    if path.suffix in (".yaml", ".yml"):
        from msk_ray.config import load_config
        from msk_ray.envs import env_class

        config = load_config(path)
        env = env_class(config.env)
        model = env.build_model(config.env, config.physics)
        return model, env.solver_limits(model, config.physics)
    try:
        if path.suffix == ".mjb":
            return mujoco.MjModel.from_binary_path(str(path)), {}
        return mujoco.MjModel.from_xml_path(str(path)), {}
    except (ValueError, mujoco.FatalError) as error:
        raise ConfigError(f"MuJoCo cannot load {path}: {' '.join(str(error).split())}") from error


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    if args.seed < 0:
        raise ConfigError(f"--seed must not be negative, not {args.seed}")
    if args.model.suffix not in (".yaml", ".yml") and not args.model.is_file():
        raise ConfigError(f"no model file {args.model}")
    states, parameters = _listed(args.states), _listed(args.parameters)
    if not args.json:
        kinds = ", ".join(states)
        announce_compiling(
            f"checking gradients of {args.model} on {args.device}: {args.worlds} states each of {kinds}, "
            f"{args.substeps} substep(s), by {args.mode}"
        )
    # torch and Warp take seconds to load; a wrong command line should not wait for them.
    from msk_ray.step import Kernels, Simulation
    from msk_ray.step.autograd.modes import make_backward
    from msk_ray.step.check.check import GradientCheck, Limits, check_gradients, check_request
    from msk_ray.step.forward.capacity import Capacity
    from msk_ray.step.forward.parameters import check_names, names_of

    backward = make_backward(args.mode)
    model, kept = load_model(args.model)
    if args.integrator is not None:
        from msk_ray.envs.options import INTEGRATORS

        model.opt.integrator = INTEGRATORS[args.integrator]
    if parameters == ["all"]:
        parameters = names_of(model)
    check_request(model, states)
    check_names(model, parameters)
    limits = Limits() if args.forward_tolerance is None else Limits(forward_mismatch=args.forward_tolerance)
    try:
        sim = Simulation(
            model,
            args.worlds,
            args.substeps,
            backward,
            args.device,
            capacity=Capacity(args.nconmax or 0, args.njmax or 0),
            tolerance=args.solver_tolerance,
            kernels=Kernels(
                iterations=args.iterations or kept.get("iterations"),
                ls_iterations=args.ls_iterations or kept.get("ls_iterations"),
            ),
        )
        pace = None if args.json else Pace("states", args.worlds * len(set(states)))
        result = check_gradients(sim, states=states, seed=args.seed, limits=limits, parameters=parameters, pace=pace)
    except UnsupportedModelError as error:
        if args.json:
            empty = GradientCheck(args.mode, args.substeps, args.worlds)
            print(json.dumps(as_json(empty, str(args.model), args.tolerance, [str(error)])))
        raise
    if args.json:
        print(json.dumps(as_json(result, str(args.model), args.tolerance, [])))
    else:
        print_table(result, str(args.model), args.tolerance)
    if not result.checked and not result.nonfinite:
        raise ConfigError(
            f"nothing could be compared: {_excluded(result)}; "
            + (_unconverged(result) or "try other --states, more --worlds or --forward-tolerance")
        )
    return 0 if result.max_rel_error <= args.tolerance else 1


def _finite(value: float | None) -> float | None:
    """JSON has no infinity: null stands for it."""
    return value if value is not None and math.isfinite(value) else None


def as_json(result: "GradientCheck", model: str, tolerance: float, unsupported: list[str]) -> dict[str, Any]:
    """The result as JSON types: an entry per state and input, null for non-finite and undefined values."""
    return {
        "model": model,
        "mode": result.mode,
        "substeps": result.substeps,
        "worlds": result.worlds,
        "checked": result.checked,
        "excluded": result.excluded,
        "excluded_kinks": result.kinks,
        "excluded_forward_mismatches": result.forward_mismatches,
        "excluded_parameter_kinks": result.parameter_kinks,
        "results": [
            {
                "state": r.state,
                "world": r.world,
                "input": r.input,
                "rel_error": _finite(r.rel_error),
                "cosine": r.cosine,
                "norm_ratio": r.norm_ratio,
            }
            for r in result.results
        ],
        "nonfinite": [asdict(lost) for lost in result.nonfinite],
        "max_rel_error": _finite(result.max_rel_error),
        "tolerance": tolerance,
        "diagnostics": {name: _finite(figure) for name, figure in result.diagnostics.items()},
        "ok": not unsupported and result.max_rel_error <= tolerance,
        "unsupported": unsupported,
    }


def _figure(error: float) -> str:
    return f"{error:.1e}" if math.isfinite(error) else "non-finite"


def _excluded(result: "GradientCheck") -> str:
    total = result.checked + result.excluded
    return (
        f"{result.excluded} of {total} states left out ({result.kinks} at a kink, {result.forward_mismatches} where "
        "the Warp forward pass differs from C MuJoCo)"
    )


def _unconverged(result: "GradientCheck") -> str:
    """What to change if the solver has not converged; empty if it has."""
    if not result.unconverged:
        return ""
    return (
        f"the solver had not converged in {result.diagnostics['solver_unconverged_substeps']:.1%} of the substeps, "
        f"where gradients are wrong: raise --iterations (now {result.limits.iterations}) and --ls-iterations (now "
        f"{result.limits.ls_iterations}) or lower --solver-tolerance"
    )


def print_table(result: "GradientCheck", model: str, tolerance: float) -> None:
    """Print one row per kind of state and input, over the states compared."""
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{model}: {result.mode}, {result.substeps} substep(s)", title_justify="left")
    for heading in ("state", "input", "states", "rel_error median", "rel_error max", "cosine min", "norm_ratio"):
        table.add_column(heading, justify="left" if heading in ("state", "input") else "right", no_wrap=True)
    for state, name in dict.fromkeys((r.state, r.input) for r in result.results):
        rows = result.of(name, state)
        errors = [r.rel_error for r in rows]
        cosines = [r.cosine for r in rows if r.cosine is not None]
        ratios = [r.norm_ratio for r in rows if r.norm_ratio is not None]
        style = "" if max(errors) <= tolerance else "red"
        table.add_row(
            state,
            name,
            str(len(rows)),
            _figure(float(np.median(errors))),
            _figure(max(errors)),
            f"{min(cosines):.6f}" if cosines else "-",
            f"{min(ratios):.4f} … {max(ratios):.4f}" if ratios else "-",
            style=style,
        )
    # A pipe or file has no width: use one at which no column is cut.
    console = Console(width=None if sys.stdout.isatty() else 120, soft_wrap=True, highlight=False)
    console.print(table)
    console.print(_excluded(result))
    if result.parameter_kinks:
        console.print(f"{result.parameter_kinks} elements of parameters left out at a kink of their own")
    if result.checked and result.excluded > MANY_EXCLUDED * (result.checked + result.excluded):
        console.print("note: many states were left out; the result covers only the others")
    if share := result.diagnostics.get("approximated_share", 0.0):
        console.print(f"approximated contacts, by the nearest law: in {share:.1%} of the substeps")
    if note := _unconverged(result):
        console.print(note, markup=False)
    for lost in result.nonfinite:
        console.print(f"non-finite: {lost}", markup=False)
    verdict = "ok" if result.max_rel_error <= tolerance else "above the tolerance"
    console.print(f"largest relative error {_figure(result.max_rel_error)}, tolerance {tolerance:.1e}: {verdict}")


if __name__ == "__main__":
    sys.exit(run(main))
