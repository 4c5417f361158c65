"""Refusals of settings that make no sense, by name and value; before anything is compiled."""

import math
from typing import Any

from train.errors import ConfigError


def at_least(config: Any, least: int, *names: str) -> None:
    """Raises `ConfigError` where one of the settings is less."""
    for name in names:
        if getattr(config, name) < least:
            raise ConfigError(f"{name} must be at least {least}, got {getattr(config, name)}")


def positive(config: Any, *names: str) -> None:
    """Raises `ConfigError` where one of the settings is not above 0 and finite."""
    for name in names:
        if not 0.0 < getattr(config, name) < math.inf:
            raise ConfigError(f"{name} must be positive, got {getattr(config, name)}")


def not_negative(config: Any, *names: str) -> None:
    """Raises `ConfigError` where one of the settings is below 0 or not finite."""
    for name in names:
        if not 0.0 <= getattr(config, name) < math.inf:
            raise ConfigError(f"{name} must not be negative, got {getattr(config, name)}")


def share(config: Any, *names: str) -> None:
    """Raises `ConfigError` where one of the settings is no share."""
    for name in names:
        if not 0.0 <= getattr(config, name) <= 1.0:
            raise ConfigError(f"{name} must lie between 0 and 1, got {getattr(config, name)}")
