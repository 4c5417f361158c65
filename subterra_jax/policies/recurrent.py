"""A trained GRU with an estimation head, as an agent that says where it is."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed
from subterra_jax.policies import senses
from subterra_jax.policies.layers import Tensors, dense, perceptron, squash
from subterra_jax.state import EnvParams


@struct.dataclass
class Memory:
    """What it remembers.

    Attributes:
        hidden: Of the GRU.
        reckoning: Dead reckoning and rings since the start.
    """

    hidden: Float[Array, "hidden"]
    reckoning: senses.Reckoning


@struct.dataclass
class Recurrent:
    """Drives by the mean of its distribution towards a goal.

    Attributes:
        tensors: Layers `memory.Dense_0`, `memory.Dense_1`, the matrix `memory.recurrent`, the layer `estimate`, and the
            layers `policy.hidden_<i>`.
        low: Smallest action, m/s and rad/s.
        high: Largest action, m/s and rad/s.
        bin_width: Of the estimation head, m.
        shown: What it is shown.
        name: Name on the leaderboard.
    """

    tensors: Tensors
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    bin_width: float = struct.field(pytree_node=False)
    shown: senses.Senses = struct.field(pytree_node=False, default=senses.PLAIN)
    name: str = struct.field(pytree_node=False, default="ppo-gru")
    uses_lidar: bool = struct.field(pytree_node=False, default=True)
    uses_map: bool = struct.field(pytree_node=False, default=False)
    privileged: bool = struct.field(pytree_node=False, default=False)

    @property
    def n_features(self) -> int:
        """Inputs of the network."""
        return self.tensors["memory.Dense_0.kernel"].shape[0]

    @property
    def n_beams(self) -> int:
        """Beams of the scans it was made for."""
        return self.shown.n_beams(self.n_features)

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Memory:
        """Nothing yet."""
        del key, obs, params
        return self.blank()

    def blank(self) -> Memory:
        """The memory before the first step."""
        hidden = jnp.zeros(self.tensors["memory.recurrent"].shape[0])
        return Memory(hidden, senses.start((), self.n_beams, self.shown))

    def act(
        self, key: PRNGKeyArray, memory: Memory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Memory]:
        """One control period."""
        del key, known
        return self.answer(memory, obs, jnp.asarray(params.start.station, jnp.float32))

    def answer(self, memory: Memory, obs: Observed, start: Float[Array, ""]) -> tuple[Action, Memory]:
        """Action and memory, from the observation and the believed start (m)."""
        part = {
            "ranges": obs.ranges,
            "odometry": jnp.stack([obs.distance, obs.heading]),
            "goal": jnp.atleast_1d(obs.goal),
            "ring_pitch": jnp.atleast_1d(obs.ring_pitch),
            "flag": jnp.atleast_1d(obs.flag),
        }
        seen = senses.look(part, start, memory.reckoning)
        hidden = self._remember(memory.hidden, seen.features)
        error, log_sigma = self._estimate(hidden)
        aim = senses.aim(seen.ahead - error, log_sigma)
        parameters = perceptron(self.tensors, "policy", jnp.concatenate([hidden, aim]), jax.nn.swish)
        action = squash(parameters[:2], self.low, self.high)
        after = Memory(hidden, senses.advance(seen.reckoning, action, False))
        # The estimate is asked for the end of this control period.
        direction = 1.0 - 2.0 * seen.reckoning.back
        there = start + seen.station + error + direction * senses.PERIOD * jnp.maximum(action[0], 0.0)
        return jnp.stack([action[0], action[1], there, log_sigma, direction]), after

    def _remember(self, before: Float[Array, "hidden"], seen: Float[Array, "n"]) -> Float[Array, "hidden"]:
        """The hidden state one step later."""
        encoded = jax.nn.swish(dense(self.tensors, "memory.Dense_0", seen))
        given = jnp.split(dense(self.tensors, "memory.Dense_1", encoded), 3)
        kept = jnp.split(before @ self.tensors["memory.recurrent"], 3)
        reset, update = jax.nn.sigmoid(given[0] + kept[0]), jax.nn.sigmoid(given[1] + kept[1] + 1.0)
        return update * before + (1.0 - update) * jnp.tanh(given[2] + reset * kept[2])

    def _estimate(self, hidden: Float[Array, "hidden"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Expected true less tracked distance, m, and log of its standard deviation."""
        share = jax.nn.softmax(dense(self.tensors, "estimate", hidden))
        centres = senses.centres(share.shape[-1], self.bin_width)
        error = jnp.sum(share * centres)
        spread = jnp.sum(share * jnp.square(centres - error))
        return error, 0.5 * jnp.log(spread + self.bin_width**2 / 12.0)
