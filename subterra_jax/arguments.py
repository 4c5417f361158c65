"""Command lines whose `--help` fits a screen and whose mistakes are one sentence.

tyro shows every option of every group, each with its whole text. Here `--help` shows the options that a command has for
itself and names the other groups, which `--help-all` shows as well.
"""

import io
import re
import shutil
import textwrap
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from typing import TypeVar

from subterra_jax.errors import SubterraError

_MAIN = ("options", "positional arguments", "subcommands")
_RULE = re.compile(r"^ *-{5,}$")
T = TypeVar("T")


class ArgumentsError(SubterraError):
    """A command line that cannot be read."""


def parse(read: Callable[[list[str]], T], words: list[str]) -> T:
    """What a command line says.

    Args:
        read: Reads words with tyro.
        words: The words.

    Raises:
        ArgumentsError: There is no such option, or not with such a value.
        SystemExit: Help was shown.
    """
    page, complaint = io.StringIO(), io.StringIO()  # without an encoding, tyro draws no boxes
    try:
        with redirect_stdout(page), redirect_stderr(complaint):
            return read(["--help" if word == "--help-all" else word for word in words])
    except SystemExit as ended:
        if ended.code:
            raise ArgumentsError(sentence(complaint.getvalue())) from None
        print(page.getvalue().rstrip() if "--help-all" in words else brief(page.getvalue()))
        raise


def brief(page: str) -> str:
    """A page of help without the groups of further options, which are named at its end."""
    lines = [line.rstrip() for line in page.splitlines()]
    kept: list[str] = []
    others, shown = [], True
    for line, below in zip(lines, [*lines[1:], ""], strict=True):
        if _RULE.match(line):
            continue
        if _RULE.match(below) and line[1:2].strip():
            shown = line.strip() in _MAIN
            others += [] if shown else [line.strip().removesuffix(" options")]
        if shown and (line or kept[-1:] != [""]):
            kept += [line] if line[:1] in ("", " ") else _wrapped(line)
    more = [f"--help-all shows further options: {', '.join(others)}."] if others else []
    return "\n".join([*kept, *more]).rstrip()


def _wrapped(line: str) -> list[str]:
    """A line as lines no longer than the terminal is wide; tyro leaves descriptions as they are."""
    return textwrap.wrap(line, shutil.get_terminal_size().columns)


def sentence(complaint: str) -> str:
    """What is wrong, without the help texts around it."""
    lines = [line.strip() for line in complaint.splitlines()]
    if plain := [line.partition("error: ")[2] for line in lines if "error: " in line]:
        return f"{plain[-1]}; --help shows what there is"
    rules = [k for k, line in enumerate(lines) if _RULE.match(line)]
    inside = [line for line in lines[rules[0] + 1 : (*rules, len(lines))[1]] if line] if rules else lines
    if inside and inside[0].startswith("Missing from"):
        inside = ["missing: " + ", ".join(line for line in inside if line.startswith("--"))]
    return f"{' '.join(inside).rstrip('.')}; --help shows what there is"
