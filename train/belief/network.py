"""The weights of a learnt sensor, and what fixes their shapes and the filter around it."""

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from subterra_jax.policies.belief import KIND
from subterra_jax.policies.belief_scan import N_FEATURES

Weights = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class BeliefLayout:
    """What fixes every array shape and the meaning of the outputs; a checkpoint carries it.

    Attributes:
        action_low: Smallest action, m/s and rad/s.
        action_high: Largest action, m/s and rad/s.
        hidden: Widths of the network.
        habits: Fields of `subterra_jax.policies.belief.Habits`.
    """

    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    hidden: tuple[int, ...]
    habits: dict[str, float]


class BeliefNetworks:
    """The sensor's weights.

    Attributes:
        layout: Their layout.
    """

    kind = KIND

    def __init__(self, layout: BeliefLayout) -> None:
        self.layout = layout

    def init(self, key: PRNGKeyArray) -> Weights:
        """Untrained weights: the nominal likelihood with the exponent of the particle filter, and nothing beside it."""
        widths = (N_FEATURES, *self.layout.hidden, 1)
        layers = {}
        for index, (n, m) in enumerate(itertools.pairwise(widths)):
            last = index == len(widths) - 2
            kernel = jax.random.normal(jax.random.fold_in(key, index), (n, m)) * jnp.sqrt(2.0 / n)
            layers[f"hidden_{index}"] = {"kernel": 0.0 * kernel if last else kernel, "bias": jnp.zeros(m)}
        return {"scan": layers, "temper": jnp.zeros(()), "nominal": jnp.log(0.5)}

    def policy_shapes(self) -> Any:
        """Shapes and types of a policy."""
        return jax.eval_shape(self.init, jax.random.PRNGKey(0))


def named(weights: Weights) -> dict[str, Any]:
    """The weights by the names that `subterra_jax.policies.belief_scan` knows."""
    layers = {f"scan.{name}.{part}": leaf for name, layer in weights["scan"].items() for part, leaf in layer.items()}
    return {**layers, "temper": weights["temper"], "nominal": weights["nominal"]}
