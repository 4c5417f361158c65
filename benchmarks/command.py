"""Command lines of this room: settings from words, mistakes as one sentence with status 2, other commands run."""

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

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


class Ran(NamedTuple):
    """End of a command."""

    status: int  # Exit status
    message: str  # Where it failed, the last line of its log, which is the sentence of an error; empty where it did not
    memory: float  # Peak memory, GiB


def run_module(module: str, *words: object, log: Path | None = None) -> Ran:
    """Runs `python -m MODULE WORDS` as a user would; what it prints goes to the end of `log` if that is given."""
    command = [sys.executable, "-m", module, *map(str, words)]
    print(f"$ python -m {' '.join(command[2:])}", flush=True)
    if log is not None:
        log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") if log is not None else nullcontext() as out:
        process = subprocess.Popen(command, stdout=out, stderr=None if out is None else subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    text = "" if log is None else log.read_text(errors="replace").replace("\r", "\n").strip()
    last = text.splitlines()[-1].strip() if text else f"ended with status {process.returncode}"
    return Ran(process.returncode, last if process.returncode else "", usage.ru_maxrss / 2**20)


def require_least(settings: Any, **least: int) -> None:
    """Checks that settings are not below their smallest values.

    Raises:
        BenchmarkError: A setting is too small; the message names it.
    """
    for name, smallest in least.items():
        if getattr(settings, name) < smallest:
            raise BenchmarkError(f"{name} must be at least {smallest}, got {getattr(settings, name)}")
