"""How good are the gradients of a learned model of the simulator? Compare them with the simulator's own.

    python docs/examples/world_model_audit.py policies/go1_velocity.pt
    python docs/examples/world_model_audit.py g1.pt --set env.motion=builtin:squat --transitions 1000 10000

One core is enough; set OMP_NUM_THREADS=1, because such small networks are slower with threads.

1. A policy with exploration noise collects transitions, each with one exact vector-Jacobian product (VJP).
2. A world model, an MLP from the state in the base's axes and the servos' targets to the change of the state, is fitted
   to the first N of them: once to the transitions alone, and once also to the VJPs (Sobolev training).
3. From new states, the gradient of the env's return over H env steps, and of a random projection of the final state,
   with respect to noise added to the policy's actions, is taken through the simulator and through the models. The
   policy is in the loop, as in first-order learning. Costs of the actions themselves are left out of the return: every
   model has their gradient right.

cosine, size   of a model's gradient to the simulator's, and its norm divided by that of the simulator's; 1 is exact
first, all     with respect to the first action, or to all H actions
imagined       the model is rolled out on its own predictions
followed       the model's derivatives are taken along the simulator's own states
on, off        states and actions with the noise of the data, or with --off-noise, which the data lack

A size near 0, a cosine near 0: the model's gradient says nothing. Writes rows.json, table.md and audit.png. The robot
needs a free joint first and hinges otherwise, as Go1 and G1 have.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor, nn

from msk_ray.config import load_config
from msk_ray.envs import Env, EnvState, make_env
from msk_ray.step import StepState
from msk_ray.step.autograd.tangent import quat_conjugate, quat_exp, quat_log, quat_multiply, quat_rotate
from msk_ray.training import SavedPolicy, load_policy

HELD_OUT = 0.1
"""Share of the transitions that choose when a fit stops; of as many more, the error is reported."""
COLLECTING = 256
"""Worlds that collect transitions."""
SETTLE = 25
"""Env steps between resets and states that count."""
Step = Callable[[Tensor, StepState], StepState]


# States in the base's own axes. D = 2 nv entries: base 3 + 3, joints, the same of velocities.


def displaced(state: StepState, by: Tensor, *, linear: bool = False) -> StepState:
    """The state moved by `by` (W, D), in the axes of its base; `linear`: right for by = 0, with its slope."""
    orientation = state.qpos[:, 3:7]
    shift, turn, joints, push, rest = by.split(_parts(state), dim=-1)
    position = state.qpos[:, :3] + quat_rotate(orientation, shift)
    # The second derivative of `quat_exp` is NaN at 0.
    rotation = torch.cat((torch.ones_like(turn[:, :1]), 0.5 * turn), dim=-1) if linear else quat_exp(turn)
    turned = quat_multiply(orientation, rotation)
    velocity = state.qvel[:, :3] + quat_rotate(orientation, push)
    return state._replace(
        qpos=torch.cat((position, turned, state.qpos[:, 7:] + joints), dim=-1),
        qvel=torch.cat((velocity, state.qvel[:, 3:] + rest), dim=-1),
    )


def difference(state: StepState, end: StepState) -> Tensor:
    """What `displaced` needs to come from a state to another, (W, D)."""
    inverse = quat_conjugate(state.qpos[:, 3:7])
    shift = quat_rotate(inverse, end.qpos[:, :3] - state.qpos[:, :3])
    turn = quat_log(quat_multiply(inverse, end.qpos[:, 3:7]))
    push = quat_rotate(inverse, end.qvel[:, :3] - state.qvel[:, :3])
    joints, rest = end.qpos[:, 7:] - state.qpos[:, 7:], end.qvel[:, 3:] - state.qvel[:, 3:]
    return torch.cat((shift, turn, joints, push, rest), dim=-1)


def features(state: StepState) -> Tensor:
    """Height, direction of gravity, joints and velocities: what does not change with place and heading."""
    inverse = quat_conjugate(state.qpos[:, 3:7])
    down = torch.tensor([0.0, 0.0, -1.0]).expand(len(inverse), 3)
    gravity, velocity = quat_rotate(inverse, down), quat_rotate(inverse, state.qvel[:, :3])
    return torch.cat((state.qpos[:, 2:3], gravity, state.qpos[:, 7:], velocity, state.qvel[:, 3:]), dim=-1)


def _parts(state: StepState) -> list[int]:
    return [3, 3, state.qpos.shape[1] - 7, 3, state.qvel.shape[1] - 3]


# 1. Transitions


class Data(NamedTuple):
    """N transitions, and one VJP of each."""

    qpos: Tensor
    qvel: Tensor
    control: Tensor
    change: Tensor
    """(N, D)."""
    along: Tensor
    """The VJP's direction (N, D)."""
    to_state: Tensor
    """The VJP: derivative of along · change by a displacement of the state, (N, D)."""
    to_control: Tensor
    """The same by the control (N, A)."""

    def state(self, rows: Any = slice(None)) -> StepState:
        """The states in which the transitions begin."""
        qpos = self.qpos[rows]
        return StepState(qpos, self.qvel[rows], qpos.new_zeros(len(qpos), 0))

    def part(self, rows: Any) -> "Data":
        """Some of them."""
        return Data(*(values[rows] for values in self))


class Robot:
    """An environment whose worlds a policy moves, with noise.

    Args:
        env: the environment; it has been told to ignore contact forces.
        saved: the policy.
        noise: standard deviation of what is added to its actions.
        seed: of the noise.
    """

    def __init__(self, env: Env[Any], saved: SavedPolicy, noise: float, seed: int) -> None:
        self.env, self.noise = env, noise
        self.network = saved.network(env).requires_grad_(False)
        self._generator = torch.Generator().manual_seed(seed)

    def draw(self) -> Tensor:
        """Noise of the actions of one step (W, A)."""
        return self.noise * torch.randn(self.env.nworld, self.env.action_size, generator=self._generator)

    def go_on(self, scale: Tensor | None) -> Data:
        """One step of all worlds, and resets; with VJPs along random directions if their scale (D,) is given."""
        env, before = self.env, self.env.state.physics
        action = (self.network(env.observation()) + self.draw()).clamp(-1.0, 1.0)
        control = env.control(action).detach().requires_grad_(scale is not None)
        by = torch.zeros(len(action), 2 * env.model.nv, requires_grad=scale is not None)
        start = displaced(before, by)
        end = env.sim.step(control, *start)
        change = difference(start, end)
        along, slopes = torch.zeros_like(by), (torch.zeros_like(by), torch.zeros_like(control))
        if scale is not None:
            along = torch.randn(by.shape, generator=self._generator) / scale
            slopes = torch.autograd.grad((along * change).sum(), (by, control))
        reached = env.reached(StepState(*(part.detach() for part in end)), action)
        physics = reached.physics
        wild = ~(torch.cat(physics, dim=-1).abs() < 1e3).all(-1)
        done = wild | env.fell(physics) | env.timed_out(reached)
        env.state = env.carried(reached.replaced(done, env.reset_state())).detach()
        found = Data(before.qpos, before.qvel, control, change, along, *slopes)
        finite = torch.cat(found, dim=-1).isfinite().all(-1) & ~wild
        return Data(*(values.detach()[finite] for values in found))


def collect(robot: Robot, count: int) -> Data:
    """Transitions with VJPs, in random order, so that the first N are like all."""
    first = [robot.go_on(None).change for _ in range(SETTLE)]
    scale = torch.cat(first).std(0).clamp_min(1e-6)
    parts: list[Data] = []
    begin = shown = time.monotonic()
    while (done := sum(len(part.qpos) for part in parts)) < count:
        parts.append(robot.go_on(scale))
        if (now := time.monotonic()) > shown + 10.0:
            shown = now
            print(
                f"  {done} of {count} transitions, {(count - done) * (now - begin) / max(done, 1):.0f} s left",
                flush=True,
            )
    found = Data(*(torch.cat(values) for values in zip(*parts, strict=True)))
    return found.part(torch.randperm(len(found.qpos), generator=torch.Generator().manual_seed(0))[:count])


# 2. World models


class WorldModel(nn.Module):
    """An MLP that predicts the change of the state; inputs and outputs are scaled to those of its data."""

    def __init__(self, data: Data, width: int, layers: int) -> None:
        super().__init__()
        given = torch.cat((features(data.state()), data.control), dim=-1)
        self.middle, self.spread = given.mean(0), given.std(0).clamp_min(1e-4)
        self.mean, self.scale = data.change.mean(0), data.change.std(0).clamp_min(1e-6)
        sizes = [given.shape[1], *[width] * layers]
        hidden = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.SiLU())]
        self.layers = nn.Sequential(*hidden, nn.Linear(width, len(self.mean)))

    def forward(self, state: StepState, control: Tensor) -> Tensor:
        """The change of the state (W, D)."""
        given = torch.cat((features(state), control), dim=-1)
        out: Tensor = self.mean + self.scale * self.layers((given - self.middle) / self.spread)
        return out

    def step(self, control: Tensor, state: StepState) -> StepState:
        """The state that follows."""
        return displaced(state, self(state, control))


class Units(NamedTuple):
    """What makes errors comparable: standard deviations of states and controls, and the mean squares of VJPs."""

    state: Tensor
    control: Tensor
    square: Tensor

    @staticmethod
    def of(data: Data) -> "Units":
        """Of these transitions."""
        seen = features(data.state()).std(0)
        # Base: place and heading leave the change as it is, so their unit hardly matters.
        speeds = seen[4 + data.qpos.shape[1] - 7 :]
        state = torch.cat((seen[:1].expand(3), seen[1:4], seen[4 : 4 + data.qpos.shape[1] - 7], speeds)).clamp_min(1e-4)
        control = data.control.std(0).clamp_min(1e-4)
        slopes = torch.cat((data.to_state * state, data.to_control * control), dim=-1)
        return Units(state, control, slopes.square().sum(-1).median())


def losses(model: WorldModel, data: Data, units: Units, jacobians: bool) -> tuple[Tensor, Tensor]:
    """Mean squared error of the change, in units of its spread, and of the VJPs, relative to their size."""
    by = torch.zeros_like(data.change).requires_grad_(jacobians)
    control = data.control.detach().requires_grad_(jacobians)
    change = model(displaced(data.state(), by, linear=True), control)
    error = ((change - data.change) / model.scale).square().mean()
    if not jacobians:
        return error, torch.zeros(())
    slopes = torch.autograd.grad((data.along * change).sum(), (by, control), create_graph=True)
    wrong = (slopes[0] - data.to_state) * units.state, (slopes[1] - data.to_control) * units.control
    square = torch.cat(wrong, dim=-1).square().sum(-1) / units.square
    # A few states, such as those at an impact, have VJPs a hundred times larger: they count by their length.
    return error, ((1.0 + square).sqrt() - 1.0).mean()


def fit(data: Data, jacobians: bool, args: argparse.Namespace, seed: int) -> WorldModel:
    """The model that is best on the held-out share of the data."""
    torch.manual_seed(seed)
    held = max(int(HELD_OUT * len(data.qpos)), 1)
    train, test = data.part(slice(held, None)), data.part(slice(min(held, 2000)))
    model, units = WorldModel(train, args.width, args.layers), Units.of(train)
    optimiser = torch.optim.AdamW(model.parameters(), lr=1e-3, weight_decay=1e-4)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, args.updates)
    best, kept = float("inf"), {name: value.clone() for name, value in model.state_dict().items()}
    for update in range(1, args.updates + 1):
        batch = train.part(torch.randint(len(train.qpos), (args.batch,)))
        optimiser.zero_grad()
        torch.stack(losses(model, batch, units, jacobians)).sum().backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        rates.step()
        if update % max(args.updates // 20, 1) == 0:
            loss = sum(float(part.detach()) for part in losses(model, test, units, jacobians))
            if loss < best:
                best, kept = loss, {name: value.clone() for name, value in model.state_dict().items()}
    model.load_state_dict(kept)
    return model.requires_grad_(False)


@torch.no_grad()
def one_step_error(model: WorldModel, data: Data) -> float:
    """Share of the variance of the change that the model does not explain, mean over its entries."""
    wrong = (model(data.state(), data.control) - data.change).square().mean(0)
    return float((wrong / data.change.var(0).clamp_min(1e-12)).mean())


# 3. Gradients


class Gradients(NamedTuple):
    """Gradients (H, W, T, A) of the return and the projection, by horizon, and the states of the rollout."""

    reward: list[Tensor]
    projection: list[Tensor]
    states: list[StepState]


def gradients(robot: Robot, step: Step, start: EnvState, noise: Tensor, direction: Tensor, at: list[int]) -> Gradients:
    """Gradients with respect to noise (T, W, A) of the actions, with the policy in the loop and no resets."""
    env = robot.env
    of_states = [i for i, name in enumerate(env.reward_names) if not name.startswith("action")]
    env.state, total = start, torch.zeros(len(noise[0]))
    added = noise.clone().requires_grad_()
    states, targets = [start.physics], []
    for t in range(at[-1]):
        action = (robot.network(env.observation()) + added[t]).clamp(-1.0, 1.0)
        physics = step(env.control(action), env.state.physics)
        reached = env.reached(physics, action)
        terms = env.reward_terms(physics, action, env.observation_of(reached))
        total = total + terms[:, of_states].sum(-1)
        env.state = env.carried(reached)
        states.append(StepState(*(part.detach() for part in physics)))
        if t + 1 in at:
            targets.append((total, difference(start.physics, physics) @ direction))
    env.state = start
    found = [
        [torch.autograd.grad(target.sum(), added, retain_graph=True)[0][:h].transpose(0, 1) for target in pair]
        for h, pair in zip(at, targets, strict=True)
    ]
    return Gradients([pair[0] for pair in found], [pair[1] for pair in found], states)


def following(model: WorldModel, states: Sequence[StepState]) -> Step:
    """Steps with the simulator's states and the model's derivatives."""
    ends = iter(states[1:])

    def step(control: Tensor, state: StepState) -> StepState:
        guess, end = model.step(control, state), next(ends)
        return StepState(*(e + g - g.detach() for e, g in zip(end, guess, strict=True)))

    return step


def compared(found: Gradients, exact: Gradients, at: list[int]) -> Iterator[dict[str, Any]]:
    """Cosines and sizes over worlds, for both targets and for the first and all actions."""
    for target in ("reward", "projection"):
        for h, mine, true in zip(at, getattr(found, target), getattr(exact, target), strict=True):
            for which, rows in (("first", slice(1)), ("all", slice(None))):
                a, b = mine[:, rows].flatten(1).double(), true[:, rows].flatten(1).double()
                usable = a.isfinite().all(-1) & b.isfinite().all(-1) & (b.norm(dim=-1) > 0.0)
                a, b = a[usable], b[usable]
                cosine = torch.nn.functional.cosine_similarity(a, b, dim=-1, eps=1e-30).numpy()
                size = (a.norm(dim=-1) / b.norm(dim=-1)).numpy()
                quartiles = {
                    name: np.quantile(values, (0.25, 0.5, 0.75)).tolist() if len(values) else [float("nan")] * 3
                    for name, values in (("cosine", cosine), ("size", size))
                }
                yield {"target": target, "horizon": h, "which": which, "worlds": len(a), **quartiles}


class Test(NamedTuple):
    """Where gradients are compared."""

    robot: Robot
    start: EnvState
    noise: Tensor
    direction: Tensor
    exact: Gradients
    data: Data
    """Transitions before it, for the one-step error."""


def tests(
    make: Callable[[int, int], Env[Any]], saved: SavedPolicy, args: argparse.Namespace, scale: Tensor
) -> dict[str, Test]:
    """The states on the data and off it, with the exact gradients there."""
    found = {}
    for name, noise, seed in (("on", args.noise, 101), ("off", args.off_noise, 102)):
        robot = Robot(make(args.worlds, seed), saved, noise, seed)
        data = [robot.go_on(None) for _ in range(SETTLE + 20)][SETTLE:]
        start = robot.env.state.detach()
        added = torch.stack([robot.draw() for _ in range(args.horizons[-1])])
        direction = torch.randn(len(scale), generator=torch.Generator().manual_seed(seed)) / scale
        began = time.monotonic()
        step: Step = lambda control, state, robot=robot: robot.env.sim.step(control, *state)  # noqa: E731
        exact = gradients(robot, step, start, added, direction, args.horizons)
        print(f"  exact gradients {name} the data: {time.monotonic() - began:.0f} s", flush=True)
        parts = Data(*(torch.cat(values) for values in zip(*data, strict=True)))
        found[name] = Test(robot, start, added, direction, exact, parts)
    return found


def audit(args: argparse.Namespace) -> list[dict[str, Any]]:
    """All rows: one per number of transitions, kind of fit, seed, states, rollout, target, actions and horizon."""
    saved = load_policy(args.policy)
    config = saved.config
    if args.overrides:
        text = config.model_dump_json()
        path = args.output / "config.yaml"
        path.write_text(text)
        config = load_config(path, args.overrides)

    def make(worlds: int, seed: int) -> Env[Any]:
        env = make_env(config.env, config.physics, worlds, "cpu", seed)
        # Forces of contacts carry no gradient, and states that a model has imagined have none.
        env.measurements.ignore_contact_forces = True
        return env

    most = max(args.transitions)
    print(f"collecting {most} transitions of {config.env.name} ...", flush=True)
    began = time.monotonic()
    data = collect(Robot(make(min(COLLECTING, most), 1), saved, args.noise, 1), most)
    print(f"  {most / (time.monotonic() - began):.0f} transitions/s with their VJPs", flush=True)
    scale = Units.of(data).state
    found = tests(make, saved, args, scale)
    rows: list[dict[str, Any]] = []
    for count in sorted(args.transitions):
        for kind in ("transitions", "and Jacobians"):
            for seed in range(args.seeds):
                rows += _audited(data.part(slice(count)), kind, seed, found, args)
    return rows


def _audited(
    data: Data, kind: str, seed: int, found: dict[str, Test], args: argparse.Namespace
) -> list[dict[str, Any]]:
    began = time.monotonic()
    model = fit(data, kind != "transitions", args, seed)
    seconds, rows = time.monotonic() - began, []
    for name, test in found.items():
        error = one_step_error(model, test.data)
        for way in ("imagined", "followed"):
            step: Step = model.step if way == "imagined" else following(model, test.exact.states)
            mine = gradients(test.robot, step, test.start, test.noise, test.direction, args.horizons)
            facts = {"n": len(data.qpos), "fit": kind, "seed": seed, "states": name, "rollout": way, "error": error}
            rows += [facts | row for row in compared(mine, test.exact, args.horizons)]
        shown = [r for r in rows if r["states"] == name and r["rollout"] == "imagined" and r["which"] == "all"]
        cosines = " ".join(f"{r['cosine'][1]:.2f}" for r in shown if r["target"] == "reward")
        print(
            f"  n {len(data.qpos):6} {kind:13} seed {seed} {name:3} error {error:.3f}, cosines {cosines} "
            f"({seconds:.0f} s)",
            flush=True,
        )
    return rows


# Table and picture


def pick(rows: list[dict[str, Any]], **wanted: Any) -> list[dict[str, Any]]:
    """Rows that have these values."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def middle(rows: list[dict[str, Any]], what: str, quartile: int = 1) -> float:
    """Mean over seeds of a quartile over worlds."""
    return float(np.mean([row[what][quartile] for row in rows])) if rows else float("nan")


def table(rows: list[dict[str, Any]], args: argparse.Namespace) -> str:
    """Markdown: the return's gradient with respect to all actions."""
    head = ["states", "rollout", "n", "fitted to", "error", *(f"H {h}" for h in args.horizons)]
    lines = [head, ["---"] * len(head)]
    for states in ("on", "off"):
        for way in ("imagined", "followed"):
            for count in sorted(args.transitions):
                for kind in ("transitions", "and Jacobians"):
                    own = pick(rows, states=states, rollout=way, n=count, fit=kind, target="reward", which="all")
                    cells = [
                        f"{middle(of, 'cosine'):.2f} / {middle(of, 'size'):.2f}"
                        for of in (pick(own, horizon=h) for h in args.horizons)
                    ]
                    error = f"{np.mean([row['error'] for row in own]):.3f}"
                    lines.append([states, way, f"{count}", kind, error, *cells])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def draw(rows: list[dict[str, Any]], args: argparse.Namespace, path: Path) -> None:
    """Cosine and size over the horizon, on and off the data; shades are quartiles over worlds."""
    figure, axes = plt.subplots(2, 4, figsize=(16, 7), sharex=True, sharey="row")
    colours = dict(
        zip(sorted(args.transitions), plt.cm.viridis(np.linspace(0.8, 0.1, len(args.transitions))), strict=True)
    )
    columns = [(states, way) for states in ("on", "off") for way in ("imagined", "followed")]
    for column, (states, way) in enumerate(columns):
        for (count, colour), kind in ((item, k) for item in colours.items() for k in ("transitions", "and Jacobians")):
            own = pick(rows, states=states, rollout=way, n=count, fit=kind, target="reward", which="all")
            at = [pick(own, horizon=h) for h in args.horizons]
            for axis, what in zip(axes[:, column], ("cosine", "size"), strict=True):
                low, median, high = ([middle(of, what, q) for of in at] for q in range(3))
                style = "--" if kind == "transitions" else "-"
                axis.plot(args.horizons, median, style, color=colour, marker="o", ms=3, label=f"{count} {kind}")
                if count == max(args.transitions):
                    axis.fill_between(args.horizons, low, high, color=colour, alpha=0.12)
        axes[0, column].set(title=f"{states} the data, {way}", ylim=(-0.2, 1.02))
        axes[1, column].set(xlabel="horizon [env steps]", xscale="log", yscale="log")
        axes[1, column].set_xticks(args.horizons, [str(h) for h in args.horizons])
        axes[1, column].axhline(1.0, color="k", lw=0.5)
    axes[0, 0].set_ylabel("cosine with the exact gradient")
    axes[1, 0].set_ylabel("size / exact size")
    axes[0, 0].legend(fontsize=7)
    figure.savefig(path, dpi=90, bbox_inches="tight")


def main() -> None:
    """Audit the models that the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("policy", type=Path, help="a checkpoint (.pt); its env, physics and policy are used")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help="changed settings")
    p.add_argument("--output", type=Path, default=Path("world_model_audit"), help="folder (default: %(default)s)")
    p.add_argument("--transitions", type=int, nargs="+", default=[1000, 10_000, 100_000], metavar="N")
    p.add_argument("--noise", type=float, default=0.2, help="of actions in the data (default: %(default)s)")
    p.add_argument("--off-noise", type=float, default=0.6, help="of actions off the data (default: %(default)s)")
    p.add_argument("--horizons", type=int, nargs="+", default=[1, 2, 4, 8, 16, 32], metavar="H", help="env steps")
    p.add_argument("--worlds", type=int, default=64, help="starting states of each kind (default: %(default)s)")
    p.add_argument("--width", type=int, default=256, help="of the model's layers (default: %(default)s)")
    p.add_argument("--layers", type=int, default=2, help="hidden ones (default: %(default)s)")
    p.add_argument("--updates", type=int, default=5000, help="of each model (default: %(default)s)")
    p.add_argument("--batch", type=int, default=256, help="transitions per update (default: %(default)s)")
    p.add_argument("--seeds", type=int, default=1, help="models per fit; the data are the same (default: %(default)s)")
    args = p.parse_args()
    args.horizons.sort()
    args.output.mkdir(parents=True, exist_ok=True)
    rows = audit(args)
    (args.output / "rows.json").write_text(json.dumps(rows))
    text = table(rows, args)
    (args.output / "table.md").write_text(text)
    print(f"cosine / size of the return's gradient to all actions, medians over {args.worlds} worlds:\n{text}")
    draw(rows, args, args.output / "audit.png")
    print(f"written to {args.output}: rows.json, table.md, audit.png")


if __name__ == "__main__":
    main()
