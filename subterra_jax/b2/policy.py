"""A trained gait: a perceptron from proprioception to the joint offsets that are added to the trot."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.policies.files import GAIT, PolicyError, PolicyFile, read
from subterra_jax.policies.layers import Tensors, perceptron

RELEASED = "B2Walk-v0"
_CLIP = 10.0  # standard deviations


@struct.dataclass
class WalkPolicy:
    """Twelve joint offsets for one observation of `WalkEnv`: the mean of the distribution that was trained.

    Attributes:
        tensors: `statistics.mean` and `statistics.std` of one observation, and the layers `policy.hidden_<i>`.
        name: Name shown to people.
    """

    tensors: Tensors
    name: str = struct.field(pytree_node=False, default=RELEASED)

    @property
    def n_observation(self) -> int:
        """Size of one observation."""
        return self.tensors["statistics.mean"].shape[0]

    def act(self, observation: Float[Array, "*batch n_obs"]) -> Float[Array, "*batch 12"]:
        """Return the action, in [-1, 1]."""
        scaled = (observation - self.tensors["statistics.mean"]) / self.tensors["statistics.std"]
        parameters = perceptron(self.tensors, "policy", jnp.clip(scaled, -_CLIP, _CLIP), jax.nn.swish)
        return jnp.tanh(parameters[..., : parameters.shape[-1] // 2])


def load(source: str | Path = RELEASED) -> tuple[WalkPolicy, dict[str, Any]]:
    """Loads a gait and its facts.

    Args:
        source: A `.safetensors` file with its `.json` beside it, or the name of a released policy.

    Raises:
        PolicyError: The file is missing or damaged, or holds no gait.
    """
    file = read(source)
    return make_policy(file), file.facts


def make_policy(file: PolicyFile) -> WalkPolicy:
    """Makes a gait from its file; raises `PolicyError` for another kind of policy, or tensors that do not fit."""
    if file.facts["kind"] != GAIT:
        raise PolicyError(f"{file.path}: a policy of kind {file.facts['kind']!r}, which is no gait")
    try:
        policy = WalkPolicy({name: jnp.asarray(tensor) for name, tensor in file.tensors.items()}, file.facts["name"])
        jax.eval_shape(policy.act, jax.ShapeDtypeStruct((policy.n_observation,), jnp.float32))
    except (KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"{file.path}: tensors and layout do not belong together ({error})") from error
    return policy


def check_fits(policy: WalkPolicy, size: int, source: str | Path) -> None:
    """Raises `PolicyError` where a gait was made for observations of another size than `size`."""
    if policy.n_observation != size:
        raise PolicyError(f"{source}: made for observations of {policy.n_observation} numbers, the B2 gives {size}")


def zero_action(observation: Float[Array, "*batch n_obs"]) -> Float[Array, "*batch 12"]:
    """Return the action that leaves the trot unchanged."""
    return jnp.zeros((*observation.shape[:-1], 12))
