"""A policy played live: episodes in real time, one after the other, on a screen."""

import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch

from msk_ray.envs import Env
from msk_ray.play.screen import Screen
from msk_ray.training.policy_group import Policy


class Episode(NamedTuple):
    """An episode that has ended."""

    score: float
    """Sum of its rewards."""
    seconds: float
    """Simulated time [s]."""
    ending: str
    """`fell`, `diverged`, or `time` if it lasted to its limit."""


@torch.no_grad()
def play_episodes(
    env: Env[Any], policy: Policy, steps: int, seed: int, screen: Screen, speed: float
) -> Iterator[Episode]:
    """Play episodes of the first world until the screen is closed.

    Args:
        env: the worlds.
        policy: raw observations (W, O) to actions (W, A).
        steps: largest number of env steps of an episode.
        seed: of the initial states.
        screen: where they are shown.
        speed: simulated seconds per second.

    Yields:
        Each episode that ended while the screen was open.
    """
    period = env.config.control_timestep
    env.generator.manual_seed(seed)
    while screen.is_open():
        env.state = env.reset_state()
        started, score = time.monotonic(), 0.0
        for step in range(1, steps + 1):
            action = policy(env.observation())
            control = env.control(action)
            transition = env.step(action, auto_reset=False)
            screen.show(env.state.physics, control)
            score += float(transition.reward[0])
            ahead = started + step * period / speed - time.monotonic()
            if ahead > 0.0:
                time.sleep(ahead)
            if not screen.is_open():
                return
            if bool(transition.terminated[0]):
                break
        fell = "fell" if bool(transition.terminated[0]) else "time"
        yield Episode(score, step * period, "diverged" if bool(transition.diverged[0]) else fell)
