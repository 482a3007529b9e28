"""What a trial is: one frozen, checked tree of settings, read from YAML."""

from msk_ray.config.load import (
    apply_overrides,
    describe_fault,
    dump_yaml,
    load_config,
    merge,
    parse_config,
    parse_override,
    read_config,
    read_yaml,
)
from msk_ray.config.schema import (
    AntEnvConfig,
    CartPoleEnvConfig,
    Config,
    EnvConfig,
    EvaluationConfig,
    FdConfig,
    HorizonSchedule,
    NetworkConfig,
    PhysicsConfig,
    ShacConfig,
    TrialConfig,
)

__all__ = [
    "AntEnvConfig",
    "CartPoleEnvConfig",
    "Config",
    "EnvConfig",
    "EvaluationConfig",
    "FdConfig",
    "HorizonSchedule",
    "NetworkConfig",
    "PhysicsConfig",
    "ShacConfig",
    "TrialConfig",
    "apply_overrides",
    "describe_fault",
    "dump_yaml",
    "load_config",
    "merge",
    "parse_config",
    "parse_override",
    "read_config",
    "read_yaml",
]
