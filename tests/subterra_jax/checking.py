"""The run-time checker of the simulator's annotations."""

from typing import Any

from beartype import beartype


def check_functions(function: Any) -> Any:
    """Beartype for functions, not for dataclasses: vmap and jit rebuild pytrees with placeholders in their fields."""
    return function if function.__name__ == "__init__" else beartype(function)
