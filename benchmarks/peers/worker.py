"""One simulator's figures, printed as JSON: started by peers.py with the simulator's packages first on the path."""

import argparse
import json
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from simulators import Ours, Steps, fork
from torch import Tensor, nn

REPEATS = 5
HIDDEN = (400, 200, 100)


def network(inputs: int, outputs: int) -> nn.Sequential:
    """The layers of configs/ant.yaml."""
    layers: list[nn.Module] = []
    for width in HIDDEN:
        layers += [nn.Linear(inputs, width), nn.ELU(), nn.LayerNorm(width)]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


def milliseconds(work: Callable[[], object], device: str) -> float:
    """Median duration [ms] after two runs that are not counted."""

    def now() -> float:
        if device != "cpu":
            torch.cuda.synchronize()
        return time.perf_counter()

    times = []
    for _ in range(2 + REPEATS):
        begin = now()
        work()
        times.append(1e3 * (now() - begin))
    return statistics.median(times[2:])


def one_step(sim: Steps, qpos: Tensor, qvel: Tensor, ctrl: Tensor) -> None:
    """An env step and its pullback to state and control."""
    inputs = [t.detach().requires_grad_() for t in (ctrl, qpos, qvel)]
    after, speed = sim.step(0, *inputs)
    torch.autograd.grad(after.sum() + speed.sum(), inputs)


class Epoch:
    """An epoch of SHAC operation by operation: rollout, its gradient, Adam's step and the fit of a critic.

    The same for every simulator. Positions and velocities are the observation, the forward speed is the reward.
    """

    def __init__(self, sim: Steps, qpos: Tensor, qvel: Tensor, horizon: int) -> None:
        self._sim, self._start, self._horizon = sim, (qpos, qvel), horizon
        device = qpos.device
        self._actor = network(sim.nq + sim.nv, sim.nu).to(device)
        self._critic = network(sim.nq + sim.nv, 1).to(device)
        betas = (0.7, 0.95)
        self._steps = [torch.optim.Adam(n.parameters(), 1e-3, betas, fused=True) for n in (self._actor, self._critic)]

    def __call__(self) -> None:
        qpos, qvel = self._start
        seen, total = [], qpos.new_zeros(len(qpos))
        for slot in range(self._horizon):
            obs = torch.cat((qpos, qvel), -1)
            action = torch.tanh(self._actor(obs) + 0.3 * torch.randn(len(obs), self._sim.nu, device=obs.device))
            qpos, qvel = self._sim.step(slot, action, qpos, qvel)
            seen.append(obs.detach())
            total = total + qvel[:, 0]
        loss = -(total + self._critic(torch.cat((qpos, qvel), -1))[:, 0]).mean()
        self._descend(0, self._actor, loss)
        rows, targets = torch.cat(seen), total.detach().repeat(self._horizon)
        for _ in range(16):
            for picked in torch.randperm(len(rows), device=rows.device).chunk(4):
                self._descend(1, self._critic, (self._critic(rows[picked])[:, 0] - targets[picked]).square().mean())

    def _descend(self, which: int, net: nn.Module, loss: Tensor) -> None:
        self._steps[which].zero_grad()
        parameters = list(net.parameters())
        for parameter, found in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = found
        nn.utils.clip_grad_norm_(parameters, 1.0)
        self._steps[which].step()


def main() -> None:
    """Measure what the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("peer", choices=["ours", "pr1535", "pr1423"])
    p.add_argument("--xml", required=True)
    p.add_argument("--states", required=True, help="numpy file with qpos and qvel to start from")
    p.add_argument("--worlds", type=int, required=True)
    p.add_argument("--substeps", type=int, required=True)
    p.add_argument("--horizon", type=int, required=True)
    p.add_argument("--device", required=True)
    args = p.parse_args()
    torch.manual_seed(0)
    make = (args.xml, args.worlds, args.substeps, args.horizon, args.device)
    sim: Steps = Ours(*make) if args.peer == "ours" else fork(args.peer, *make)
    states = np.load(args.states)
    which = np.arange(args.worlds) % len(states["qpos"])
    qpos, qvel = (torch.tensor(states[n][which], dtype=torch.float32, device=args.device) for n in ("qpos", "qvel"))
    ctrl = 0.3 * (2.0 * torch.rand(args.worlds, sim.nu, device=args.device) - 1.0)
    inputs = [t.clone().requires_grad_() for t in (ctrl, qpos, qvel)]
    ends = sim.step(0, *inputs)
    found = torch.autograd.grad(sum(end.sum() for end in ends), inputs)
    step = milliseconds(lambda: one_step(sim, qpos, qvel, ctrl), args.device)
    epoch = milliseconds(Epoch(sim, qpos, qvel, args.horizon), args.device)
    few = slice(0, min(args.worlds, len(states["qpos"])))
    gradients = [g[few].flatten().tolist() for g in found]
    print(
        json.dumps({"step": step, "epoch": epoch, "end": [e[few].flatten().tolist() for e in ends], "grad": gradients})
    )


if __name__ == "__main__":
    main()
