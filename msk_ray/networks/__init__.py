"""Policy, value networks and observation statistics."""

from msk_ray.networks.actor import Actor
from msk_ray.networks.critic import BatchedCritic, Critic
from msk_ray.networks.normalizer import RunningMeanStd
from msk_ray.networks.parameter_hash import as_number, parameter_hash, tensor_hash
from msk_ray.networks.policy import PolicyNetwork

__all__ = [
    "Actor",
    "BatchedCritic",
    "Critic",
    "PolicyNetwork",
    "RunningMeanStd",
    "as_number",
    "parameter_hash",
    "tensor_hash",
]
