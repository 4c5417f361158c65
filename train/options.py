"""Options of a command from elsewhere: settings from a file, and the weights of a task's reward."""

import dataclasses
import importlib
import io
import json
import tomllib
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from subterra_jax.host.command import complaint_sentence
from train.config import ConfigError

ENDINGS = (".yaml", ".yml", ".toml", ".json")
_FLAT = ("config", "logs")  # groups whose options stand alone on the command line
_OF_THIS_RUN = ("out", "settings", "seeds", "resume", "overwrite")
C = TypeVar("C")


def with_weights(command: C, weights: Any) -> C:
    """Returns a command with an option for each weight of a reward, `--reward.NAME`.

    Args:
        command: The command, a frozen dataclass.
        weights: Params of the reward, a dataclass of numbers; None for a task without.
    """
    if weights is None:
        return command
    fields = [(field.name, float, float(getattr(weights, field.name))) for field in dataclasses.fields(weights)]
    named = [(name, kind, dataclasses.field(default=value)) for name, kind, value in fields]
    reward = dataclasses.make_dataclass("Reward", named, frozen=True, namespace={"__doc__": type(weights).__doc__})
    own: Any = dataclasses.make_dataclass(
        type(command).__name__,
        [("reward", reward, dataclasses.field(default_factory=reward))],
        bases=(type(command),),
        frozen=True,
        # By the module tyro finds the comments that are shown as help.
        namespace={"__doc__": type(command).__doc__, "__module__": type(command).__module__},
    )
    made: C = own(**vars(command))
    return made


def reward_of(command: Any) -> dict[str, float]:
    """Returns the weights that a command asks for, by name; none where it has no such options."""
    reward = getattr(command, "reward", None)
    return {} if reward is None else dataclasses.asdict(reward)


def insert_file(words: list[str], read: Callable[[list[str]], Any]) -> list[str]:
    """Puts the settings of the file that `--config` names before the words, which override them.

    Args:
        words: Words of the command line.
        read: Reads a command line; for a mistake it prints to stderr and raises `SystemExit`.

    Raises:
        ConfigError: The file cannot be read, or one of its settings is none.
    """
    if (path := _named_file(words)) is None:
        return words
    settings = read_settings(path)
    own = [word for name, value in settings.items() for word in _words(name, value)]
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint), redirect_stdout(io.StringIO()):
            read([*own, *([] if "out" in settings else ["--out", "out"])])
    except SystemExit as ended:
        raise ConfigError(f"{path}: {complaint_sentence(complaint.getvalue())}") from ended
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return [*own, *words]


def read_settings(path: Path) -> dict[str, Any]:
    """Reads settings by the names that the command line has for them.

    Args:
        path: A YAML, TOML or JSON file, or the `config.json` of a run folder.

    Raises:
        ConfigError: It cannot be read, or holds no settings.
    """
    if path.suffix not in ENDINGS:
        raise ConfigError(f"{path}: must end in {', '.join(ENDINGS)}")
    try:
        settings = _parser(path.suffix)(path.read_text())
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else " ".join(str(error).split())
        raise ConfigError(f"{path}: cannot be read ({reason})") from error
    if not isinstance(settings, dict) or not all(isinstance(name, str) for name in settings):
        raise ConfigError(f"{path}: must hold settings by name")
    if "schema" not in settings:
        return settings
    if "command" not in settings:
        raise ConfigError(f"{path}: has no field 'command', which runs from the command line write")
    return settings["command"]


def settings_of(command: Any) -> dict[str, Any]:
    """Returns a command as `read_settings` reads it again, without what concerns one run alone."""
    values = {name: value for name, value in dataclasses.asdict(command).items() if name not in _OF_THIS_RUN}
    return json.loads(json.dumps(values, default=str))


def _named_file(words: list[str]) -> Path | None:
    """Returns the file that `--config` names; the last one."""
    found = None
    for word, following in pairwise([*words, ""]):
        if word == "--config":
            found = Path(following)
        elif word.startswith("--config="):
            found = Path(word.removeprefix("--config="))
    return found


def _parser(suffix: str) -> Callable[[str], Any]:
    if suffix == ".toml":
        return tomllib.loads
    if suffix == ".json":
        return json.loads
    try:
        yaml: Any = importlib.import_module("yaml")
    except ImportError as missing:
        raise ConfigError("settings in YAML need pyyaml, which is not installed: pip install pyyaml") from missing

    def load(text: str) -> Any:
        try:
            return yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ValueError(str(error)) from error

    return load


def _words(name: str, value: Any, flat: bool = False) -> list[str]:
    """Returns a setting as words of the command line; none where it is null or a flag that is off."""
    if isinstance(value, dict):
        flat = flat or name in _FLAT
        prefix = "" if flat else f"{name}."
        return [word for key, inner in value.items() for word in _words(f"{prefix}{key}", inner, flat)]
    option = f"--{name.replace('_', '-')}"
    if value is None or value is False:
        return []
    if value is True:
        return [option]
    return [option, *map(str, value)] if isinstance(value, list) else [option, str(value)]
