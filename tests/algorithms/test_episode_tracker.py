"""Episode returns across rollouts, by hand."""

import torch

from msk_ray.algorithms.episode_tracker import EpisodeTracker


def test_episodes_are_summed_across_rollouts() -> None:
    tracker = EpisodeTracker(2, torch.device("cpu"))
    rewards = torch.tensor([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]])
    never = torch.zeros(3, 2, dtype=torch.bool)
    assert set(tracker.update(rewards, never)) == {"train/episodes"}
    done = never.clone()
    done[0, 0] = True  # world 0 ends at step 0 with 6 + 1 = 7 after 4 steps
    done[2, 0] = True  # and again at step 2 with 2 + 3 = 5 after 2 steps
    figures = tracker.update(rewards, done)
    assert figures["train/episode_return"] == 6.0
    assert figures["train/episode_length"] == 3.0
    assert figures["train/episodes"] == 2
    done = never.clone()
    done[0, 1] = True  # world 1: 60 + 60 + 10 after 7 steps
    figures = tracker.update(rewards, done)
    assert figures["train/episode_return"] == 130.0
    assert figures["train/episode_length"] == 7.0
