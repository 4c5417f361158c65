"""Command lines of this room: settings from words, mistakes as one sentence with status 2."""

from collections.abc import Callable
from typing import Any, TypeVar

import tyro

from subterra_jax.host.command import INPUT_ERRORS, parse, run_command
from subterra_jax.host.errors import SubterraError

S = TypeVar("S")


class BenchmarkError(SubterraError):
    """A benchmark cannot run with these settings, inputs or outputs."""


def run_main(
    name: str,
    settings: Callable[..., S],
    act: Callable[[S], int | None],
    *,
    description: str | None = None,
    words: list[str] | None = None,
    interrupted: str = "interrupted",
) -> int:
    """Reads a command line, runs the command and returns its exit status.

    Args:
        name: Name of the command after `python -m benchmarks.`.
        settings: Dataclass of its settings, as tyro reads it.
        act: The command; it returns its status, or `None` for 0.
        description: First part of `--help`; the docstring of `settings` if not given.
        words: Words of the command line; those of this process if not given.
        interrupted: Message after Ctrl-C.

    Returns:
        The command's own status; 2 after a user's mistake; 130 after Ctrl-C.
    """
    prog = f"python -m benchmarks.{name}"
    config = parse(lambda given: tyro.cli(settings, args=given, prog=prog, description=description), words)
    return run_command(lambda: act(config), interrupted, INPUT_ERRORS)


def require_least(settings: Any, **least: int) -> None:
    """Checks that settings are not below their smallest values.

    Raises:
        BenchmarkError: A setting is too small; the message names it.
    """
    for name, smallest in least.items():
        if getattr(settings, name) < smallest:
            raise BenchmarkError(f"{name} must be at least {smallest}, got {getattr(settings, name)}")
