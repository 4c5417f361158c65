"""Network of a policy's file: memory, sizes, bounds of the action."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from jaxtyping import Array, Float

from subterra_jax.policies import inputs
from subterra_jax.policies.memories import MEMORIES, Memory
from subterra_jax.policies.network import Shape


@dataclasses.dataclass(frozen=True)
class Layout:
    """Everything about a policy that is no weight."""

    memory: Memory  # what is kept between observations
    shape: Shape  # sizes of the network
    action_low: tuple[float, ...]  # smallest action, m/s and rad/s
    action_high: tuple[float, ...]  # largest action, m/s and rad/s
    standing: float = 0.5  # share of the largest speed by which the range of the tanh goes below 0

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "Layout":
        """Reads a layout.

        Raises:
            KeyError: Something is missing.
            TypeError: Something is not known.
            ValueError: There is no such memory.
        """
        own = {field.name for field in dataclasses.fields(Memory)}
        memory = Memory(**{name: value for name, value in values["memory"].items() if name in own})
        shape = dict(values["shape"])
        if memory.kind not in MEMORIES:
            raise ValueError(f"memory must be one of {', '.join(MEMORIES)}, got {memory.kind!r}")
        shape["hidden"] = tuple(shape["hidden"])
        low, high = tuple(values["action_low"]), tuple(values["action_high"])
        return cls(memory, Shape(**shape), low, high, float(values["standing"]))

    def reckoned_way(self, seen: Float[Array, "n"]) -> Float[Array, ""]:
        """Returns the reckoned way to go among the inputs of one observation, m."""
        return inputs.FAR * seen[inputs.WAY_AT]
