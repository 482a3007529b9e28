"""The settings of a trial. Every field has a unit or range; unknown keys are refused."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    PositiveFloat,
    SerializeAsAny,
    ValidationInfo,
    model_validator,
)

from msk_ray.config.algorithms import (
    BUILT_IN,
    AlgorithmConfig,
    AlgorithmSettings,
    ExplorationSchedule,
    PpoConfig,
    ShacConfig,
    ignored_settings,
)
from msk_ray.config.environments import UndeclaredEnv, settings_class
from msk_ray.config.execution import ExecutionConfig
from msk_ray.config.horizons import HorizonSchedule
from msk_ray.config.loggers import logger_paths
from msk_ray.config.packages import require
from msk_ray.config.physics import PhysicsConfig
from msk_ray.config.schedules import CommandSchedule
from msk_ray.config.sections import SHOWN, Count, EnvSettings, Section, Text, Undeclared, Whole
from msk_ray.config.unread import unread_settings
from msk_ray.errors import ConfigError, brief


def _declared_settings(value: Any, info: ValidationInfo) -> Any:
    """Validate the `env` section with the settings class of the environment that it names."""
    if isinstance(value, EnvSettings) or not isinstance(value, Mapping):
        return value
    try:
        settings = settings_class(value.get("name"))
    except ConfigError as error:
        if info.context == SHOWN:
            return UndeclaredEnv.because(str(error), value)
        raise ValueError(str(error)) from error
    return settings.model_validate(value, context=info.context)


class ContactStart(Section):
    """Contact physics at the start of a curriculum; null keeps the trial's value."""

    solref: tuple[PositiveFloat, PositiveFloat] | None = None
    """Contact time constant [s] and damping ratio."""
    solreffriction: tuple[PositiveFloat, PositiveFloat] | None = None
    """Time constant [s] and damping ratio of the friction directions; (1, 1) is viscous."""

    @model_validator(mode="after")
    def _something(self) -> "ContactStart":
        if not self.model_dump(exclude_none=True):
            raise ValueError("write solref, solreffriction or both")
        return self


class ContactCurriculum(Section):
    """Train with softer contacts first, and move step by step to the contacts of `physics`."""

    start: ContactStart
    epochs: Count
    """Steps from `start` to the trial's physics, one per epoch."""


class NetworkConfig(Section):
    """A multilayer perceptron with normalised hidden layers."""

    hidden: Annotated[tuple[Annotated[int, Field(gt=0, le=65536)], ...], Field(max_length=64)] = (64, 64)
    """Sizes of the hidden layers."""
    activation: Literal["elu", "silu", "relu", "tanh"] = "elu"


class ActorConfig(NetworkConfig):
    """Policy network. In training, actions are drawn from a Gaussian; tanh squashes them."""

    log_std: float = -1.0
    """Initial log standard deviation, before tanh."""
    state_std: bool = False
    """Let the standard deviation depend on the observation, as in SAPO; false: one for all observations."""
    output_gain: PositiveFloat = 1.0
    """Gain of the last layer's initial weights; a small gain starts near action 0 for every observation."""


class CriticConfig(NetworkConfig):
    """Value network(s)."""

    count: Annotated[int, Field(ge=1, le=2)] = 1
    """Number of critics; with two, the smaller value is used."""


class EvaluationConfig(Section):
    """Deterministic evaluation on fixed seeds: the only score by which policies are ranked."""

    interval: Count = 10
    """Epochs between evaluations."""
    nworld: Count = 64
    """Worlds, each of which runs one episode."""
    steps: Count | None = None
    """Env steps; null: the env's episode length."""
    seed: Whole = 1234
    variant: Text | None = None
    """Physics of the score; null: the env's reference physics."""


class TrialConfig(Section):
    """Length, seed and starting point of a trial."""

    epochs: Count = 500
    """Number of policy updates."""
    seed: Whole = 0
    """Seed of all random numbers, except the episodes of evaluations (`evaluation.seed`)."""
    start_from: Text | None = None
    """Checkpoint of another trial, such as a best.pt: start from its networks and observation statistics. null: start
    from random networks. Optimisers and worlds start new either way. If the file has a policy only, the critic starts
    untrained, and the policy may get worse before it gets better."""


class Config(Section):
    """One trial."""

    env: Annotated[SerializeAsAny[EnvSettings], BeforeValidator(_declared_settings)]
    physics: PhysicsConfig = PhysicsConfig()
    curriculum: ContactCurriculum | None = None
    """Softer contacts at the start; null trains with `physics` from the start."""
    algorithm: AlgorithmConfig = AlgorithmConfig()
    shac: ShacConfig = ShacConfig()
    ppo: PpoConfig = PpoConfig()
    actor: ActorConfig = ActorConfig()
    critic: CriticConfig = CriticConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    trial: TrialConfig = TrialConfig()
    execution: ExecutionConfig = ExecutionConfig()

    @property
    def algorithm_settings(self) -> AlgorithmSettings:
        """The settings of the algorithm that the trial runs."""
        if self.algorithm.name in BUILT_IN:
            section: AlgorithmSettings = getattr(self, self.algorithm.name)
            return section
        return self.algorithm.settings

    def check_installed(self) -> None:
        """Raise if a package or model that the settings need is not on this machine. Loads nothing.

        Raises:
            ConfigError: the message names what to install.
        """
        require(self.algorithm_settings.packages, f"algorithm.name: {self.algorithm.name}")
        logger_paths(self.execution.loggers)
        self.env.check_installed()

    @property
    def algorithm_section(self) -> str:
        """The dotted section of these settings."""
        return self.algorithm.name if self.algorithm.name in BUILT_IN else "algorithm.settings"

    @property
    def unfinished(self) -> list[str]:
        """A line for each schedule that training ends before. No error, because epochs can be added to a trial."""
        ends = {f"env.{name}.end": value.end for name, value in self.env if isinstance(value, CommandSchedule)}
        if self.curriculum is not None:
            ends["curriculum.epochs"] = self.curriculum.epochs
        for name, value in self.algorithm_settings:
            if isinstance(value, HorizonSchedule | ExplorationSchedule):
                ends[f"{self.algorithm_section}.{name}.epochs"] = value.epochs
        last = self.trial.epochs
        return [
            f"{key} is epoch {end}, but training ends at trial.epochs, {last}: the schedule stays unfinished"
            for key, end in ends.items()
            if end > last
        ]

    @property
    def undeclared(self) -> str:
        """Why the environment's or algorithm's class cannot be found; empty if both can."""
        return next((s.why for s in (self.env, self.algorithm_settings) if isinstance(s, Undeclared)), "")

    @property
    def ignored(self) -> list[str]:
        """Dotted sections and settings that the trial's algorithm does not use. They have their defaults."""
        return ignored_settings(self.algorithm.name, self.algorithm_settings)

    @model_validator(mode="after")
    def _without_what_the_algorithm_ignores(self) -> "Config":
        # A base config can serve several algorithms: settings for the others are not part of this trial.
        config = self
        for key in self.ignored:
            section, *path = key.split(".")
            config = config.model_copy(update={section: _at_default(config, section, path)})
        return config

    @model_validator(mode="after")
    def _physics_fits_env(self) -> "Config":
        variants = self.env.variants
        if isinstance(self.env, UndeclaredEnv):
            return self
        for field, name in (("physics.variant", self.physics.variant), ("evaluation.variant", self.evaluation.variant)):
            if name is not None and name not in variants:
                known = f"write one of {', '.join(variants)}" if variants else "leave it out"
                raise ValueError(f"{field}: env {self.env.name} has no physics named {brief(name)}; {known}")
        return self

    @model_validator(mode="after")
    def _consistent(self) -> "Config":
        self.physics.resolve_substeps(self.env.control_timestep)
        self._check_gpus()
        self.execution.check_integrator(self.physics.integrator)
        self.execution.check_order(self.physics.integrator)
        self.algorithm_settings.check(self)
        if self.curriculum is not None:
            self._check_curriculum()
        return self

    def _check_gpus(self) -> None:
        gpus, nworld = self.execution.gpus, self.env.nworld
        if gpus > 1 and not self.algorithm_settings.parallel:
            raise ValueError(
                f"execution.gpus {gpus}: {self.algorithm.name} trains in one process; write execution.gpus: 1, or "
                "algorithm.name: shac"
            )
        if nworld % gpus:
            raise ValueError(
                f"execution.gpus {gpus} must divide env.nworld {nworld}: write {nworld // gpus * gpus or gpus}"
            )

    def _check_curriculum(self) -> None:
        if "cone" not in self.env.reads_physics:
            raise ValueError(f"curriculum: {self.env.name} has no contacts; leave it out")
        if self.physics.backward not in ("tape_per_substep", "tape_all"):
            raise ValueError("curriculum needs physics.backward: tape_per_substep or tape_all")

    @model_validator(mode="after")
    def _everything_is_read(self, info: ValidationInfo) -> "Config":
        if info.context != SHOWN:
            for key, why in unread_settings(self):
                raise ValueError(f"{key}: {why} leave it out")
        return self

    def as_dict(self) -> dict[str, Any]:
        """Plain data for `parse_config`, without settings that the algorithm does not use."""
        data = self.model_dump(mode="json")
        for key in self.ignored:
            *sections, name = key.split(".")
            owner = data
            for section in sections:
                owner = owner[section]
            del owner[name]
        if not data["physics"]["fd"]:
            del data["physics"]["fd"]
        if self.algorithm.name in BUILT_IN:
            del data["algorithm"]["settings"]
        return data


def _at_default(owner: Section, name: str, path: list[str]) -> Any:
    """The default of a setting, or a section with the setting at `path` reset to its default."""
    if not path:
        return type(owner).model_fields[name].get_default(call_default_factory=True)
    section: Section = getattr(owner, name)
    return section.model_copy(update={path[0]: _at_default(section, path[0], path[1:])})
