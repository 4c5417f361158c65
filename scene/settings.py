"""Settings that make no sense are refused before anything is read."""

import math
from dataclasses import fields, is_dataclass
from typing import Any

from scene.errors import SubterraError

_POSITIVE = ("spacing", "voxel", "cutoff", "gauge", "length", "width", "height", "diameter", "size")


class SettingError(SubterraError):
    """A setting that no build can have."""


def check_settings(config: Any, prefix: str = "") -> None:
    """Refuses numbers that are negative or not finite, in a tree of dataclasses; some may not be 0 either.

    Args:
        config: The settings.
        prefix: Of the options' names, for messages.

    Raises:
        SettingError: Names the option as it stands on a command line, and its value.
    """
    for part in fields(config):
        value, name = getattr(config, part.name), f"{prefix}{part.name.replace('_', '-')}"
        if is_dataclass(value):
            check_settings(value, f"{name}.")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, (int, float)) and not isinstance(number, bool):
                check_number(name, number)


def check_number(name: str, value: float) -> None:
    """Refuses one number; `name` says whether it may be 0.

    Raises:
        SettingError: Names the option and the value.
    """
    if not math.isfinite(value):
        raise SettingError(f"--{name} must be a finite number, got {value}")
    if value < 0.0:
        raise SettingError(f"--{name} must not be negative, got {value:g}")
    if value == 0.0 and name.endswith(_POSITIVE):
        raise SettingError(f"--{name} must be above 0, got {value:g}")
