"""A user's own Python code by name: files that register something, and `module:NAME` or `FILE.py:NAME`."""

import hashlib
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from subterra_jax.host.errors import SubterraError


class UserCodeError(SubterraError):
    """A user's file or module cannot be loaded."""


def load_file(path: Path) -> ModuleType:
    """Runs a Python file, once in a process for each content, and returns it as a module.

    Raises:
        UserCodeError: The file is missing, or raises an error.
    """
    name = f"{path.stem}_{file_digest(path)[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UserCodeError(f"{path}: is no Python file")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # a file that exits would end the command without a word
        del sys.modules[name]
        raise UserCodeError(f"{path}: {type(error).__name__}: {error}") from error
    return module


def load_module(source: str) -> ModuleType:
    """Runs a user's module: a `.py` file, or the name of a module that Python can import.

    Raises:
        UserCodeError: The module cannot be loaded.
    """
    if source.endswith(".py"):
        return load_file(Path(source))
    try:
        return importlib.import_module(source)
    except (Exception, SystemExit) as error:  # a user's code raises anything
        raise UserCodeError(f"{source}: {error}") from error


def load_object(name: str) -> Any:
    """Loads `module:NAME` or `FILE.py:NAME`, as a class or a function.

    Raises:
        UserCodeError: The module cannot be imported, or has no such name.
    """
    place, _, attribute = name.rpartition(":")
    module = load_module(place)
    try:
        return getattr(module, attribute)
    except AttributeError as error:
        raise UserCodeError(f"{name}: {place} has no {attribute!r}") from error


def file_digest(path: Path) -> str:
    """Returns the SHA-256 of a user's file.

    Raises:
        UserCodeError: The file cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise UserCodeError(f"{path}: cannot be read ({error.strerror})") from error
