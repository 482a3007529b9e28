import torch
from torch import nn

from msk_ray import Algorithm, AlgorithmSettings, EpochResult


class RandomSearch(Algorithm):
    """Moves the weights of a linear policy at random, and back if the rewards that follow are smaller."""

    class Settings(AlgorithmSettings):
        differentiates = False
        noise: float = 0.1
        steps: int = 16

    @classmethod
    def policy_network(cls, config, obs_size, action_size):
        return nn.Sequential(nn.Linear(obs_size, action_size), nn.Tanh())

    @torch.no_grad()
    def update(self, epoch):
        before, old = nn.utils.parameters_to_vector(self.network.parameters()), self.reward()
        moved = before + self.settings.noise * torch.randn_like(before)
        nn.utils.vector_to_parameters(moved, self.network.parameters())
        if (new := self.reward()) < old:
            nn.utils.vector_to_parameters(before, self.network.parameters())
        return EpochResult(2 * self.settings.steps * self.env.nworld, {"train/reward": max(old, new)})

    def reward(self):
        steps = range(self.settings.steps)
        rewards = [self.env.step(self.policy(self.env.observation())).reward for _ in steps]
        return float(torch.stack(rewards).mean())
