"""What trained agents with a learnt localiser share: its weights, a map that it may take, and ablations of it."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import jax

from subterra_jax.policies.locate import memory
from subterra_jax.policies.locate.map_strip import map_strip
from subterra_jax.policies.memories import Given
from subterra_jax.policies.trained import Trained, flat, nested
from subterra_jax.state import EnvParams


class Localised(Trained):
    """A trained agent whose tensors may hold a localiser."""

    prefix: ClassVar[str]  # beginning of the names of the localiser's tensors
    uses_lidar = True
    map: Any  # the map; None has none
    hides_map: bool  # take no map: `with_map` changes nothing
    blind: bool  # cut what the walls tell the localiser: an ablation

    @property
    def uses_map(self) -> bool:
        return self.map is not None

    @property
    def takes_map(self) -> bool:
        return any(name.startswith(f"{self.prefix}{memory.MAP}.") for name in self.tensors)

    @property
    def given(self) -> Given:
        own = part(self.tensors, self.prefix)
        return Given(nested(own) if own else None, self.map, self.blind)

    def localiser_shapes(self) -> Any:
        front = memory.front_of(part(self.tensors, self.prefix))
        return jax.eval_shape(lambda key: memory.init(front, key, self.takes_map), jax.random.key(0))

    def check_tensors(self, wanted: Any) -> None:
        """Compares names and shapes of the tensors with those wanted.

        Raises:
            KeyError: One is missing.
            ValueError: One has another shape or name.
        """
        shapes = flat(wanted)
        for name, leaf in shapes.items():
            if self.tensors[name].shape != leaf.shape:
                raise ValueError(f"{name} is {self.tensors[name].shape}, not {leaf.shape}")
        if further := sorted(set(self.tensors) - set(shapes)):
            raise ValueError(f"{further[0]} is of no such network")

    def with_map(self, params: EnvParams) -> Self:
        """Returns the agent with the map of a task if it takes one; runs on the host. A way back is driven without."""
        if not self.takes_map or self.hides_map or self.blind or params.errand != "stop":
            return self
        return self._with(map=map_strip(params.tunnel))

    def without_map(self) -> Self:
        """Returns the agent with the same weights, and no map."""
        return self._with(map=None, hides_map=True, name=f"{self.name}, no map")

    def without_walls(self) -> Self:
        """Returns the agent with the same weights, and nothing that the walls tell its localiser."""
        return self._with(map=None, blind=True, name=f"{self.name}, cut")

    def _with(self, **changes: Any) -> Self:
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]  # each subclass is a dataclass


def part(tensors: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Returns the tensors whose names begin with `prefix`, without it."""
    return {name.removeprefix(prefix): leaf for name, leaf in tensors.items() if name.startswith(prefix)}
