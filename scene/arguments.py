"""Command lines whose `--help` fits a screen and whose mistakes are one sentence.

tyro shows every option of every group, each with its whole text. Here `--help` shows the options that a command has
for itself and names the groups of the others, which `--help-all` shows as well.
"""

import io
import re
import shutil
import sys
import textwrap
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from typing import TypeVar

_MAIN = ("options", "config options", "positional arguments", "subcommands")
_RULE = re.compile(r" +-{5,}$")

T = TypeVar("T")


def parse(read: Callable[[list[str]], T], args: list[str] | None = None) -> T:
    """What a command line says.

    Args:
        read: Reads the words of a command line with tyro.
        args: The words; those of the process where not given.

    Raises:
        SystemExit: With 0 once help was shown; with 2 after one sentence on stderr that says what is wrong.
    """
    args = list(sys.argv[1:] if args is None else args)
    page, complaint = io.StringIO(), io.StringIO()  # without an encoding, tyro draws no boxes
    asked = ["--help" if word == "--help-all" else word for word in args]
    try:
        with redirect_stdout(page), redirect_stderr(complaint):
            return read(asked)
    except SystemExit as ended:
        if ended.code:
            print(f"error: {_sentence(complaint.getvalue())}", file=sys.stderr)
        else:
            print(page.getvalue() if "--help-all" in args else _short(page.getvalue()), end="")
        raise


def _short(page: str) -> str:
    """The page without its groups of further options, which are named at its end."""
    lines = [line.rstrip() for line in page.splitlines()]
    kept: list[str] = []
    left_out, shown = [], True
    for line, below in zip(lines, [*lines[1:], ""], strict=True):
        if _RULE.match(below) and not _RULE.match(line) and line[1:2] != " ":
            title = line.strip()
            shown = title in _MAIN
            if not shown:
                left_out.append(title.removesuffix(" options"))
        if shown and not _RULE.match(line) and (line or kept[-1:] != [""]):
            kept += _broken(line)
    if left_out:
        kept += _broken(f"--help-all shows further options: {', '.join(left_out)}.")
    return "\n".join(kept).rstrip() + "\n"


def _broken(line: str) -> list[str]:
    """A line as lines no longer than the terminal is wide; tyro leaves what comes from docstrings as it is."""
    return textwrap.wrap(line, shutil.get_terminal_size().columns) or [""] if line[:1] != " " else [line]


def _sentence(complaint: str) -> str:
    """What tyro put into a box, without its title, the help texts and where more help is."""
    lines = [line.rstrip() for line in complaint.splitlines()]
    rules = [k for k, line in enumerate(lines) if _RULE.match(line)]
    if not rules:
        return complaint.strip()
    inside = lines[rules[0] + 1 : (*rules, len(lines))[1]]
    named = [line.strip() for line in inside if re.match(r" {6}\S", line)]
    text = f"missing: {', '.join(named)}" if "Missing from" in inside[0] else " ".join(line.strip() for line in inside)
    return f"{text.strip().rstrip('.')}; --help shows what there is"
