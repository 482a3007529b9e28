"""Commands: what the episodes of an environment ask of the policy, drawn from ranges that are settings."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import AfterValidator, PositiveFloat, create_model
from pydantic_core import PydanticCustomError

from msk_ray.config.sections import EnvSettings, Section

SettingsT = TypeVar("SettingsT", bound=EnvSettings)
_EVERY = "every"


def ascending(span: tuple[float, float]) -> tuple[float, float]:
    """The span itself, if its numbers are in ascending order.

    Raises:
        PydanticCustomError: they are not.
    """
    if span[0] > span[1]:
        raise PydanticCustomError("order", "write the smaller number first")
    return span


Span = Annotated[tuple[float, float], AfterValidator(ascending)]
Period = Annotated[tuple[PositiveFloat, PositiveFloat], AfterValidator(ascending)]


@dataclass(frozen=True)
class Command:
    """One command of C numbers, uniform in their ranges. It is drawn when an episode begins, and with `every` again
    within it.

    The ranges and `every` are settings, `env.commands.NAME`; policies are scored with the values given here.
    """

    name: str
    """Name that `Env.command` takes."""
    ranges: Mapping[str, tuple[float, float]]
    """Smallest and largest value of each of the C numbers, by name."""
    every: tuple[float, float] | None = None
    """Shortest and longest time until it is drawn again [s], uniform; None: it is drawn once an episode."""

    def __post_init__(self) -> None:
        if not self.ranges or _EVERY in self.ranges:
            raise ValueError(f"command {self.name!r} needs ranges by name, none of them named {_EVERY!r}")


class Commands(Section):
    """The ranges of each command; policies are scored with the defaults."""

    declared: ClassVar[tuple[Command, ...]] = ()


def with_commands(*commands: Command) -> Callable[[type[SettingsT]], type[SettingsT]]:
    """Decorator that gives settings a section `commands` with the ranges of these commands.

    Raises:
        ValueError: two commands have the same name.
    """

    def decorate(settings: type[SettingsT]) -> type[SettingsT]:
        names = [command.name for command in commands]
        if duplicates := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"two commands have the name {min(duplicates)!r}")
        module = settings.__module__
        sections: dict[str, Any] = {}
        for command in commands:
            fields: dict[str, Any] = {name: (Span, span) for name, span in command.ranges.items()}
            if command.every is not None:
                fields[_EVERY] = (Period, command.every)
            section = create_model(command.name, __base__=Section, __module__=module, **fields)
            sections[command.name] = (section, section())
        all_commands = create_model("Commands", __base__=Commands, __module__=module, **sections)
        all_commands.declared = commands
        decorated = create_model(
            settings.__name__,
            __base__=settings,
            __module__=module,
            __doc__=settings.__doc__,
            commands=(all_commands, all_commands()),
        )
        decorated.__qualname__ = settings.__qualname__
        return decorated

    return decorate


def settings_with_commands(
    commands: tuple[Command, ...], settings: type[EnvSettings], owner: type
) -> type[EnvSettings]:
    """`settings` with the ranges of these commands, named as the class `Settings` inside the class `owner`."""
    if "commands" in settings.model_fields and settings.model_fields["commands"].default.declared == commands:
        return settings
    decorated = with_commands(*commands)(settings)
    decorated.__module__, decorated.__qualname__ = owner.__module__, f"{owner.__qualname__}.Settings"
    return decorated
