"""The settings of a trial: one frozen, checked tree, read from YAML."""

from msk_ray.config.algorithms import (
    ALGORITHMS,
    AlgorithmConfig,
    AlgorithmSettings,
    EntropyConfig,
    ExplorationSchedule,
    PpoConfig,
    ShacConfig,
)
from msk_ray.config.commands import Command
from msk_ray.config.environments import ENVIRONMENTS, settings_class
from msk_ray.config.execution import AS_USUAL, ExecutionConfig
from msk_ray.config.horizons import AdaptiveHorizon, ContactHorizon, HorizonSchedule
from msk_ray.config.load import (
    describe_fault,
    load_config,
    parse_config,
    parse_recorded,
    read_config,
    refuse_ignored,
)
from msk_ray.config.loggers import logger_paths
from msk_ray.config.overlay import (
    SET_HELP,
    combine,
    flattened,
    leaves,
    merge,
    overlay,
    parse_override,
    parse_overrides,
    value_at,
)
from msk_ray.config.physics import FdConfig, PhysicsConfig
from msk_ray.config.randomize import Draw, RandomizeConfig
from msk_ray.config.recorded import SCHEMA, changed_settings, current_key, current_space, current_values, env_name
from msk_ray.config.schema import (
    Config,
    ContactCurriculum,
    ContactStart,
    EvaluationConfig,
    NetworkConfig,
    TrialConfig,
)
from msk_ray.config.sections import EnvSettings, Reward
from msk_ray.config.terms import Cost, Term
from msk_ray.config.yaml_text import dump_yaml, parse_settings, parse_yaml, read_yaml
from msk_ray.registry import Registry, resolve, resolve_class

__all__ = [
    "ALGORITHMS",
    "AS_USUAL",
    "ENVIRONMENTS",
    "SCHEMA",
    "SET_HELP",
    "AdaptiveHorizon",
    "AlgorithmConfig",
    "AlgorithmSettings",
    "Command",
    "Config",
    "ContactCurriculum",
    "ContactHorizon",
    "ContactStart",
    "Cost",
    "Draw",
    "EntropyConfig",
    "EnvSettings",
    "EvaluationConfig",
    "ExecutionConfig",
    "ExplorationSchedule",
    "FdConfig",
    "HorizonSchedule",
    "NetworkConfig",
    "PhysicsConfig",
    "PpoConfig",
    "RandomizeConfig",
    "Registry",
    "Reward",
    "ShacConfig",
    "Term",
    "TrialConfig",
    "changed_settings",
    "combine",
    "current_key",
    "current_space",
    "current_values",
    "describe_fault",
    "dump_yaml",
    "env_name",
    "flattened",
    "leaves",
    "load_config",
    "logger_paths",
    "merge",
    "overlay",
    "parse_config",
    "parse_override",
    "parse_overrides",
    "parse_recorded",
    "parse_settings",
    "parse_yaml",
    "read_config",
    "read_yaml",
    "refuse_ignored",
    "resolve",
    "resolve_class",
    "settings_class",
    "value_at",
]
