"""What a trial is: one frozen, checked tree of settings, read from YAML."""

from msk_ray.config.environments import ENVIRONMENTS, settings_class
from msk_ray.config.load import describe_fault, load_config, parse_config, parse_recorded, read_config
from msk_ray.config.overlay import SET_HELP, combine, merge, overlay, parse_override, parse_overrides
from msk_ray.config.physics import FdConfig, PhysicsConfig
from msk_ray.config.recorded import current_key, current_values, env_name, first_spelling
from msk_ray.config.resolve import Registry, resolve, resolve_class
from msk_ray.config.schema import (
    AdaptiveHorizon,
    Config,
    ContactCurriculum,
    ContactStart,
    EntropyConfig,
    EvaluationConfig,
    HorizonSchedule,
    NetworkConfig,
    ShacConfig,
    TrialConfig,
)
from msk_ray.config.sections import EnvSettings, Reward
from msk_ray.config.yaml_text import dump_yaml, parse_yaml, read_yaml

__all__ = [
    "ENVIRONMENTS",
    "SET_HELP",
    "AdaptiveHorizon",
    "Config",
    "ContactCurriculum",
    "ContactStart",
    "EntropyConfig",
    "EnvSettings",
    "EvaluationConfig",
    "FdConfig",
    "HorizonSchedule",
    "NetworkConfig",
    "PhysicsConfig",
    "Registry",
    "Reward",
    "ShacConfig",
    "TrialConfig",
    "combine",
    "current_key",
    "current_values",
    "describe_fault",
    "dump_yaml",
    "env_name",
    "first_spelling",
    "load_config",
    "merge",
    "overlay",
    "parse_config",
    "parse_override",
    "parse_overrides",
    "parse_recorded",
    "parse_yaml",
    "read_config",
    "read_yaml",
    "resolve",
    "resolve_class",
    "settings_class",
]
