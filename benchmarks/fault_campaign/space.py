"""What is shot at: four small CartPole trials, or one each of two bodies and two algorithms."""

EPOCHS = 40
HANG_S = 20.0
SPACE = {
    "question": "What does a sweep survive?",
    "base": "configs/cartpole.yaml",
    "overrides": {
        "env.nworld": 8,
        "shac.horizon": 8,
        "evaluation.nworld": 8,
        "evaluation.steps": 32,
        "evaluation.interval": 2,
        "trial.epochs": EPOCHS,
        "execution.checkpoint_interval": 2,
    },
    "parameters": {"shac.actor_lr": {"grid": [5.0e-3, 1.0e-3]}},
    "seeds": "0-1",
    "resources": {"max_failures": 20, "hang_s": HANG_S},
}
"""Four trials of forty epochs, checkpointed every second one."""
BODIES = SPACE | {
    "parameters": {
        "env": {"grid": [{"label": name, "value": {"name": name, "nworld": 8}} for name in ("cartpole", "hopper")]},
        "algorithm.name": {"grid": ["shac", "ppo"]},
    },
    "seeds": "0",
}
"""Four trials of the same length: two bodies by two algorithms."""
TIMING = ("seconds", "env_steps_per_s", "time/")
