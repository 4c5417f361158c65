"""The log once more, for TensorBoard; optional, by tensorboardX, which needs neither TensorFlow nor torch."""

from pathlib import Path
from typing import Any

from train.errors import ConfigError

FOLDER = "tensorboard"


def check() -> None:
    """Raises `ConfigError` where the library that writes such logs is not installed."""
    _writer()


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
        self._writer = _writer()(str(run / FOLDER), purge_step=step + 1 if step else None)

    def write(self, record: dict[str, Any]) -> None:
        """Adds one iteration, what is not known yet left out."""
        for name, value in record.items():
            if value is not None and name not in ("step", "timing"):
                self._writer.add_scalar(_tag(name), value, record["step"])
        self._writer.add_scalar("time/steps_per_second", record["timing"]["steps_per_second"], record["step"])
        self._writer.flush()

    def close(self) -> None:
        """Closes the file."""
        self._writer.close()


def _tag(name: str) -> str:
    """Name with a group in front, by which TensorBoard sorts."""
    for group in ("reward", "loss"):
        if group in name:
            return f"{group}/{name}"
    return f"{'episodes' if name.endswith('_100') or name.startswith(('finished', 'episodes')) else 'learning'}/{name}"


def _writer() -> Any:
    try:
        from tensorboardX import SummaryWriter
    except ImportError as missing:
        raise ConfigError("tensorboard = True needs tensorboardX: pip install 'subterra-jax[logs]'") from missing
    return SummaryWriter
