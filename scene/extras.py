"""What a command of this room needs beside the simulator, told in one sentence where it is not installed."""

import importlib.util
import sys

_AS_A_COMMAND = "-m"  # what `sys.argv` begins with until `python -m` has found what it is to run


def require(commands: str | tuple[str, ...], extra: str, *modules: str) -> None:
    """Ends a command whose libraries are not installed, with status 2; does nothing where there is no such command.

    Args:
        commands: How the names of the commands begin that need them, as `scene`.
        extra: The optional dependencies that bring them.
        *modules: What has to be there.
    """
    if not _running().startswith(commands):
        return
    if missing := [module for module in modules if not _there(module)]:
        told = f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} not installed"
        print(f"error: {told}: pip install -e '.[{extra}]' in the checkout brings what is missing", file=sys.stderr)
        sys.exit(2)


def _running() -> str:
    """The module that `python -m` is about to run; empty for any other process."""
    words = sys.orig_argv
    if sys.argv[:1] != [_AS_A_COMMAND] or _AS_A_COMMAND not in words[:-1]:
        return ""
    return words[words.index(_AS_A_COMMAND) + 1]


def _there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ImportError:
        return False
