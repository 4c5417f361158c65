"""A steering that was learnt by reward: it reads ranges and its own last commands, and no rule of avoidance.

The mission says how fast to go at most, as to every steering: the largest speed, and less where the goal is believed
near. The network chooses the share of that speed, a fifth of it at least, and the yaw rate: to stand still is to stop,
which is the mission's to say.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.steering import CentreLine, Corridor, Steering
from subterra_jax.policies.networks import perceptron, squash
from subterra_jax.policies.trained import Tensors

PREFIX = "steering."
N_BEAMS = 16
N_SIGHT = N_BEAMS + 2  # numbers of one moment
SHARE, YAW_RATE = (0.0, 1.0), 1.5  # bounds of what the network chooses; rad/s to either side
# Least share: before a box the released network would stand now and then, and who stands still has stopped.
_LEAST = 0.2
_FULL = 1.05  # a tanh never reaches its end: the full speed lies a little below it
_CLIP = 10.0  # standard deviations


@struct.dataclass
class Seen:
    """Memory of a learnt steering.

    Attributes:
        corridor: The walls, which the localiser asks for.
        stack: What it saw, oldest first.
    """

    corridor: Corridor
    stack: Float[Array, "frames n_sight"]


def sight(ranges: Float[Array, "n_beams"], command: Float[Array, "2"]) -> Float[Array, "n_sight"]:
    """Returns what the network reads of one moment: ranges, m, of 16 beams, and the last command, m/s and rad/s."""
    return jnp.concatenate([ranges[:: ranges.shape[-1] // N_BEAMS], command])


def to_command(action: Float[Array, "2"], speed: Float[Array, ""]) -> Float[Array, "2"]:
    """Returns speed (m/s) and yaw rate (rad/s) of a choice of the network."""
    return jnp.stack([speed * jnp.clip(_FULL * action[0], _LEAST, SHARE[1]), action[1]])


@struct.dataclass
class LearntSteering(Steering):
    """Steers by a perceptron over the last moments.

    Attributes:
        tensors: `statistics.mean` and `statistics.std` of one moment, and the layers `policy.hidden_<i>`.
        frames: Moments that it reads.
    """

    tensors: Tensors
    frames: int = struct.field(pytree_node=False)

    def begin(self, obs: Observed, params: Any) -> Seen:
        """Finds the walls, and fills the stack with the first moment."""
        first = sight(obs.ranges, jnp.zeros(2))
        return Seen(CentreLine().begin(obs, params), jnp.repeat(first[None], self.frames, axis=0))

    def look(self, memory: Seen, obs: Observed, command: Float[Array, "2"], params: Any) -> Seen:
        """Tracks the walls, and takes in a moment."""
        now = sight(obs.ranges, command)
        stack = jnp.concatenate([memory.stack[1:], now[None]])
        return Seen(CentreLine().look(memory.corridor, obs, command, params), stack)

    def cosine(self, memory: Seen) -> Float[Array, ""]:
        """Returns the cosine of the tracked angle."""
        return CentreLine().cosine(memory.corridor)

    def steer(self, memory: Seen, speed: Float[Array, ""], params: Any) -> Float[Array, "2"]:
        """Returns the network's choice."""
        del params
        return to_command(self.choose(memory.stack), speed)

    def choose(self, stack: Float[Array, "frames n_sight"]) -> Float[Array, "2"]:
        """Returns share of the speed, and yaw rate, rad/s."""
        inputs = (stack - self.tensors["statistics.mean"]) / self.tensors["statistics.std"]
        parameters = perceptron(self.tensors, "policy", jnp.clip(inputs, -_CLIP, _CLIP).reshape(-1), jax.nn.swish)
        low, high = jnp.array([SHARE[0], -YAW_RATE]), jnp.array([SHARE[1], YAW_RATE])
        return squash(parameters[:2], low, high)

    def turn_round(self, memory: Seen) -> Seen:
        """Swaps left and right of the walls; scans of before the turn leave the stack by themselves."""
        return Seen(CentreLine().turn_round(memory.corridor), memory.stack)


def check_steering(tensors: Tensors, frames: int) -> None:
    """Refuses tensors that no steering over so many moments has.

    Raises:
        KeyError: One is missing.
        TypeError: They do not fit each other.
        ValueError: There are some for no moment, or the statistics are of something else.
    """
    if not tensors and frames == 0:
        return
    if frames < 1 or tensors["statistics.mean"].shape != (N_SIGHT,):
        raise ValueError(f"{PREFIX}statistics.mean is no mean of {N_SIGHT} numbers, or frames = {frames} is none")
    stack = jax.ShapeDtypeStruct((frames, N_SIGHT), jnp.float32)
    jax.eval_shape(LearntSteering(tensors, frames).choose, stack)
