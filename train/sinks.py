"""The log elsewhere: TensorBoard, Weights & Biases, and functions of one's own."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from subterra_jax.host.loading import load_object
from train.config import ConfigError

TENSORBOARD = "tensorboard"
Log = Callable[[dict[str, Any]], Any]


class Sink(Protocol):
    """Receiver of the log beside the files of the run folder."""

    def write(self, record: dict[str, Any]) -> None:
        """Takes one iteration's line of the log."""

    def close(self) -> None:
        """Ends the log."""


@dataclasses.dataclass(frozen=True)
class Logs:
    """Places to log to, beside the files of the run folder."""

    tensorboard: bool = False  # write the log for TensorBoard as well
    # function that is called with every line of the log, a dictionary: `module:function` or `FILE.py:function`
    log: str | None = None
    wandb: str | None = None  # project in Weights & Biases that gets every line as well

    def checked(self) -> "Logs":
        """Returns itself where all libraries and functions are there.

        Raises:
            ConfigError: A library is missing, or `log` is no function.
            UserCodeError: `log` cannot be loaded.
        """
        if self.tensorboard:
            tensorboard_writer()
        if self.log is not None:
            load_log(self.log)
        if self.wandb is not None:
            _wandb()
        return self

    def open(self, run: Path, step: int, settings: dict[str, Any]) -> list[Sink]:
        """Opens the logs of a run.

        Args:
            run: The run folder.
            step: Environment steps after which an earlier log is forgotten; 0 begins anew.
            settings: Settings of the run.
        """
        sinks: list[Sink] = []
        if self.tensorboard:
            sinks.append(Board(run, step))
        if self.log is not None:
            sinks.append(Calls(load_log(self.log), run, self.log))
        if self.wandb is not None:
            sinks.append(Wandb(self.wandb, run, settings))
        return sinks


NO_LOGS = Logs()


def load_log(name: str) -> Log:
    """Loads a function of one's own that is called with every line of the log.

    Args:
        name: `module:function` or `FILE.py:function`.

    Raises:
        ConfigError: It is no function.
        UserCodeError: It cannot be loaded.
    """
    if ":" not in name:
        raise ConfigError(f"log must be module:function or FILE.py:function, got {name!r}")
    function = load_object(name)
    if not callable(function):
        raise ConfigError(f"log = {name} is no function, but {type(function).__name__}")
    return function


class Calls:
    """A function that is called with every line of the log.

    Args:
        function: The function; it gets a dictionary.
        run: The run folder, which is added as `run`.
        name: Name of the function, for messages.
    """

    def __init__(self, function: Log, run: Path, name: str) -> None:
        self._function, self._run, self._name = function, run, name

    def write(self, record: dict[str, Any]) -> None:
        """Calls the function.

        Raises:
            ConfigError: It raises an error.
        """
        try:
            self._function({"run": str(self._run), **record})
        except Exception as error:  # a user's code raises anything
            raise ConfigError(f"log = {self._name}: {type(error).__name__}: {error}") from error

    def close(self) -> None:
        """Does nothing."""


class Wandb:
    """Scalars of every iteration in Weights & Biases, against environment steps.

    Args:
        project: Name of the project.
        run: The run folder, whose name the run gets.
        settings: Shown as the run's config.

    Raises:
        ConfigError: wandb is not installed.
    """

    def __init__(self, project: str, run: Path, settings: dict[str, Any]) -> None:
        self._run = _wandb().init(project=project, name=run.name, dir=str(run), config=settings, reinit="create_new")

    def write(self, record: dict[str, Any]) -> None:
        """Adds one iteration; scalars that are not known yet are left out."""
        flat = {**record, "steps_per_second": record["timing"]["steps_per_second"]}
        known = {name: value for name, value in flat.items() if value is not None and name not in ("step", "timing")}
        self._run.log({_tag(name): value for name, value in known.items()}, step=record["step"])

    def close(self) -> None:
        """Ends the run."""
        self._run.finish()


def _wandb() -> Any:
    try:
        import wandb
    except ImportError as missing:
        raise ConfigError("wandb = PROJECT needs wandb, which is not installed: pip install wandb") from missing
    return wandb


class Board:
    """Scalars of every iteration in `tensorboard/`, against environment steps.

    Args:
        run: The run folder.
        step: Environment steps after which an earlier log is forgotten; 0 begins anew.

    Raises:
        ConfigError: tensorboardX is not installed.
    """

    def __init__(self, run: Path, step: int = 0) -> None:
        # Iterations after the last checkpoint come again: TensorBoard then drops what it has from there on.
        self._writer = tensorboard_writer()(str(run / TENSORBOARD), purge_step=step + 1 if step else None)

    def write(self, record: dict[str, Any]) -> None:
        """Adds one iteration; scalars that are not known yet are left out."""
        for name, value in record.items():
            if value is not None and name not in ("step", "timing"):
                self._writer.add_scalar(_tag(name), value, record["step"])
        self._writer.add_scalar("time/steps_per_second", record["timing"]["steps_per_second"], record["step"])
        self._writer.flush()

    def close(self) -> None:
        """Closes the file."""
        self._writer.close()


def _tag(name: str) -> str:
    """Returns the name with a group in front, by which TensorBoard sorts."""
    for group in ("reward", "loss"):
        if group in name:
            return f"{group}/{name}"
    return f"{'episodes' if name.endswith('_100') or name.startswith(('finished', 'episodes')) else 'learning'}/{name}"


def tensorboard_writer() -> Any:
    """Returns the class that writes such logs; raises `ConfigError` where its library is not installed."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError as missing:
        raise ConfigError("tensorboard = True needs tensorboardX: pip install 'subterra-jax[logs]'") from missing
    return SummaryWriter
