"""What a trial is: one frozen, checked tree of settings, read from YAML."""

from msk_ray.config.legs import AssistConfig, LegEnvSettings, MyoLeg26EnvConfig, MyoLegEnvConfig, TerrainConfig
from msk_ray.config.load import describe_fault, load_config, parse_config, read_config
from msk_ray.config.overlay import SET_HELP, combine, merge, overlay, parse_override, parse_overrides
from msk_ray.config.schema import (
    AdaptiveHorizon,
    AntEnvConfig,
    CartPoleEnvConfig,
    Config,
    ContactCurriculum,
    ContactStart,
    EntropyConfig,
    EnvConfig,
    EvaluationConfig,
    FdConfig,
    HorizonSchedule,
    NetworkConfig,
    PhysicsConfig,
    ShacConfig,
    TrialConfig,
)
from msk_ray.config.sections import EnvSettings
from msk_ray.config.yaml_text import dump_yaml, parse_yaml, read_yaml

__all__ = [
    "SET_HELP",
    "AdaptiveHorizon",
    "AntEnvConfig",
    "AssistConfig",
    "CartPoleEnvConfig",
    "Config",
    "ContactCurriculum",
    "ContactStart",
    "EntropyConfig",
    "EnvConfig",
    "EnvSettings",
    "EvaluationConfig",
    "FdConfig",
    "HorizonSchedule",
    "LegEnvSettings",
    "MyoLeg26EnvConfig",
    "MyoLegEnvConfig",
    "NetworkConfig",
    "PhysicsConfig",
    "ShacConfig",
    "TerrainConfig",
    "TrialConfig",
    "combine",
    "describe_fault",
    "dump_yaml",
    "load_config",
    "merge",
    "overlay",
    "parse_config",
    "parse_override",
    "parse_overrides",
    "parse_yaml",
    "read_config",
    "read_yaml",
]
