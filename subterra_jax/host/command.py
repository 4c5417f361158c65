"""Commands: help that fits a screen, mistakes as one sentence on stderr, exit statuses, missing libraries.

tyro shows every option of every group, each with its whole text. Here `--help` shows the options that a command has for
itself and names the other groups, which `--help-all` shows as well.
"""

import difflib
import importlib.util
import io
import os
import re
import shutil
import sys
import textwrap
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from itertools import takewhile
from typing import TypeVar

from subterra_jax.host.errors import SubterraError

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_UNREAD = 1, 2, 130, 141
INPUT_ERRORS = (SubterraError, ValueError, OSError)  # for commands whose settings are checked by libraries, too
_MAIN_GROUPS = ("options", "positional arguments", "subcommands")
_RULE = re.compile(r" *-{5,}$")  # the line below a group's title
_MODULE_FLAG = "-m"  # `sys.argv[0]` until `python -m` has located its module

T = TypeVar("T")


def parse(read: Callable[[list[str]], T], words: list[str] | None = None, groups: tuple[str, ...] = ()) -> T:
    """Reads a command line.

    Args:
        read: Reads a list of words with tyro or argparse.
        words: The words; `None`: those of this process.
        groups: Titles of further groups of options that `--help` shows.

    Returns:
        The result of `read`.

    Raises:
        SystemExit: With 0 after help was shown; with 2 after one sentence on stderr about a mistake.
    """
    words = list(sys.argv[1:] if words is None else words)
    page, complaint = io.StringIO(), io.StringIO()  # tyro draws no boxes for a stream without an encoding
    try:
        with redirect_stdout(page), redirect_stderr(complaint):
            return read(["--help" if word == "--help-all" else word for word in words])
    except SystemExit as ended:
        if ended.code:
            print(f"error: {_misspelt(read, words) or complaint_sentence(complaint.getvalue())}", file=sys.stderr)
        else:
            text = page.getvalue().rstrip() if "--help-all" in words else _short_help(page.getvalue(), groups)
            sys.exit(run_command(lambda: print(text)))
        raise


def run_command(
    act: Callable[[], int | None],
    interrupted: str = "interrupted",
    mistakes: tuple[type[Exception], ...] = (SubterraError,),
) -> int:
    """Runs a command and returns its exit status.

    Warnings of libraries are not shown, unless Python is asked for them (`-W`, `PYTHONWARNINGS`): what a user must know
    the command says itself.

    Args:
        act: The command; it returns its status, or `None` for 0.
        interrupted: Message after Ctrl-C.
        mistakes: Errors that count as a user's mistake; others pass.

    Returns:
        The command's own status; after a mistake, which is printed as one sentence on stderr, the `exit_status` of the
        error, or 2; 130 after Ctrl-C; 141 where nobody reads on, as behind `| head`.
    """
    try:
        with warnings.catch_warnings():
            if not sys.warnoptions:
                warnings.simplefilter("ignore")
            status = act() or 0
        sys.stdout.flush()  # or a pipe that nobody reads shows as Python ends, by a traceback
        return status
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_UNREAD
    except mistakes as error:
        print(f"error: {error_sentence(error)}", file=sys.stderr)
        return getattr(error, "exit_status", EXIT_BAD_INPUT)
    except KeyboardInterrupt:
        print(interrupted, file=sys.stderr)
        return EXIT_INTERRUPTED


def error_sentence(error: BaseException) -> str:
    """Returns the text of an error on one line; one of the system begins with its file."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def require_libraries(commands: str | tuple[str, ...], extra: str, *modules: str) -> None:
    """Ends a command whose libraries are not installed, with status 2; does nothing in any other process.

    It stands in the `__init__` of a package whose files import them at their top, or in a command's `main`.

    Args:
        commands: Beginnings of the names of the commands that need the libraries, as `scene`.
        extra: The optional dependencies that bring them.
        *modules: Modules that must be installed.
    """
    if not _command_name().startswith(commands):
        return
    if missing := [module for module in modules if not _installed(module)]:
        verb = "is" if len(missing) == 1 else "are"
        brings = f"pip install -e '.[{extra}]' in the checkout brings what is missing"
        print(f"error: {', '.join(missing)} {verb} not installed: {brings}", file=sys.stderr)
        sys.exit(EXIT_BAD_INPUT)


def _command_name() -> str:
    """Returns the module that `python -m` runs or is about to run; empty for any other process."""
    running = getattr(sys.modules.get("__main__"), "__spec__", None)  # `None` until the module has been located
    if running is not None:
        return running.name.removesuffix(".__main__")
    words = sys.orig_argv[1:] if sys.argv[:1] == [_MODULE_FLAG] else []
    for index, word in enumerate(words):
        if word.startswith(_MODULE_FLAG):
            return word.removeprefix(_MODULE_FLAG) or "".join(words[index + 1 : index + 2])
    return ""


def _installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ImportError:
        return False


def _short_help(page: str, groups: tuple[str, ...]) -> str:
    """Returns a page of help without the groups of further options, which are named at its end."""
    lines = [line.rstrip() for line in page.splitlines()]
    kept: list[str] = []
    others, shown = [], True
    for line, below in zip(lines, [*lines[1:], ""], strict=True):
        if _RULE.match(line):
            continue
        if _RULE.match(below) and line[1:2].strip():
            title = line.strip()
            shown = title in (*_MAIN_GROUPS, *groups)
            others += [] if shown else [title.removesuffix(" options")]
        if shown and (line or kept[-1:] != [""]):
            kept += [line] if line[:1] in ("", " ") else _wrap(line)
    if others:
        kept += _wrap(f"--help-all shows further options: {', '.join(others)}.")
    return "\n".join(kept).rstrip()


def _wrap(line: str) -> list[str]:
    """Breaks a line at the terminal's width; tyro leaves the lines of docstrings as they are."""
    return textwrap.wrap(line, shutil.get_terminal_size().columns)


def _misspelt(read: Callable[[list[str]], object], words: list[str]) -> str:
    """Returns a sentence about the first word that names no option or command, with the nearest name that does."""
    lead = list(takewhile(lambda word: not word.startswith("-"), words))
    page = io.StringIO()
    for before in (lead, []):  # a wrong command may have no help of its own
        with suppress(SystemExit), redirect_stdout(page), redirect_stderr(io.StringIO()):
            if not page.getvalue():
                read([*before, "--help"])
    options = re.findall(r"(?<!\S)(--[a-z][\w.-]*)", page.getvalue())
    usage = page.getvalue().partition("\n\n")[0]
    commands = [name for names in re.findall(r"\{([\w,-]+)\}", usage) for name in names.split(",")]
    commands += re.findall(r"(?m)^  ([a-z-]+) {2}", page.getvalue())
    for word in words:
        name = word.partition("=")[0].replace("_", "-")
        known = options if word.startswith("--") else commands if [word] == lead[:1] else []
        if name not in known and (near := difflib.get_close_matches(name, known, n=1, cutoff=0.65)):
            return f"nothing is named {name}; {near[0]} is; --help shows what there is"
    return ""


def complaint_sentence(complaint: str) -> str:
    """Returns the mistake in a complaint of tyro or argparse, without the help texts around it."""
    lines = [line.rstrip() for line in complaint.splitlines()]
    if plain := [line.partition("error: ")[2] for line in lines if "error: " in line]:
        return f"{plain[-1]}; --help shows what there is"
    rules = [k for k, line in enumerate(lines) if _RULE.match(line)]
    inside = [line for line in lines[rules[0] + 1 : (*rules, len(lines))[1]] if line] if rules else lines
    if inside and "Missing from" in inside[0]:
        inside = ["missing: " + ", ".join(line.strip() for line in inside if re.match(r" {6}\S", line))]
    return f"{' '.join(line.strip() for line in inside).rstrip('.')}; --help shows what there is"
