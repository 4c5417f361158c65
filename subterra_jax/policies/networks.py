"""Trained networks as agents: a multilayer perceptron over stacked observations, and a GRU that estimates its station.

Both act by the mean of their distribution. Their weights are tensors by name, as a policy's file holds them.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed, n_ranges
from subterra_jax.baselines.stations import told_start
from subterra_jax.policies import senses
from subterra_jax.policies.files import Conditions, PolicyError
from subterra_jax.policies.trained import Tensors, Trained
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

_CLIP = 10.0  # standard deviations


def dense(tensors: Tensors, name: str, x: Float[Array, "*batch n"]) -> Float[Array, "*batch m"]:
    """Returns `x · <name>.kernel + <name>.bias`."""
    return x @ tensors[f"{name}.kernel"] + tensors[f"{name}.bias"]


def perceptron(
    tensors: Tensors, name: str, x: Float[Array, "*batch n"], activation: Callable[[Array], Array]
) -> Float[Array, "*batch m"]:
    """Applies the layers `<name>.hidden_0`, `<name>.hidden_1`, …, with an activation between each two."""
    index = 0
    while True:
        x = dense(tensors, f"{name}.hidden_{index}", x)
        index += 1
        if f"{name}.hidden_{index}.kernel" not in tensors:
            return x
        x = activation(x)


def glance(
    tensors: Tensors, name: str, image: Float[Array, "*batch pixels"], shape: tuple[int, int]
) -> Float[Array, "*batch n"]:
    """Applies the layers `<name>.patch` and `<name>.glance` to an image of ranges, m, row by row."""
    tiles = senses.patches(image / senses.IMAGE_RANGE, shape)
    tiles = jax.nn.swish(dense(tensors, f"{name}.patch", tiles))
    return jax.nn.swish(dense(tensors, f"{name}.glance", tiles.reshape(*tiles.shape[:-2], -1)))


def squash(mean: Float[Array, "*batch n"], low: Float[Array, "n"], high: Float[Array, "n"]) -> Float[Array, "*batch n"]:
    """Maps a network's output to an action between `low` and `high`, m/s and rad/s, by a tanh."""
    return low + 0.5 * (jnp.tanh(mean) + 1.0) * (high - low)


@struct.dataclass
class FeedForward(Trained):
    """A multilayer perceptron. It estimates its station only where the task asks for a report.

    Attributes:
        tensors: `statistics.mean` and `statistics.std` of one observation, and the layers `policy.hidden_<i>`.
        low: Smallest action, m/s and rad/s.
        high: Largest action, m/s and rad/s.
        frames: Number of observations in its input.
        image: Rows and columns of the image in an observation; None without one.
        image_at: Place of its first pixel in an observation.
        name: Name on the leaderboard.
        conditions: Conditions of its training; None: any.
    """

    kind: ClassVar[str] = "mlp"
    uses_lidar = True
    tensors: Tensors
    low: Float[Array, "n_action"]
    high: Float[Array, "n_action"]
    frames: int = struct.field(pytree_node=False)
    name: str = struct.field(pytree_node=False, default="ppo-mlp")
    conditions: Conditions | None = struct.field(pytree_node=False, default=None)
    image: tuple[int, int] | None = struct.field(pytree_node=False, default=None)
    image_at: int = struct.field(pytree_node=False, default=0)

    @classmethod
    def of_layout(cls, layout: Mapping[str, Any], **common: Any) -> "FeedForward":
        """Makes the agent of a layout with `frames`, and `image` and `image_at` if need be."""
        image = tuple(layout["image"]) if layout.get("image") else None
        return cls(**common, frames=int(layout["frames"]), image=image, image_at=int(layout.get("image_at", 0)))

    def try_out(self) -> None:
        """Answers a stack of observations, by shapes alone."""
        jax.eval_shape(self.answer, jax.ShapeDtypeStruct((self.frames, self.n_observation), jnp.float32))

    def check_task(self, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
        """Refuses observations of another length."""
        if self.n_observation != (size := env.observation_size(params)):
            raise PolicyError(f"{source}: made for observations of {self.n_observation} numbers, {env.id} has {size}")

    @property
    def n_observation(self) -> int:
        """Length of one observation."""
        return self.tensors["statistics.mean"].shape[0]

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Float[Array, "frames n_obs"]:
        """Returns the first observation, repeated."""
        del key, params
        return jnp.repeat(obs.flat[None], self.frames, axis=0)

    def act(
        self, key: PRNGKeyArray, memory: Float[Array, "frames n_obs"], obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Float[Array, "frames n_obs"]]:
        """Returns the action of one control period, and the stack with the newest observation."""
        del key, params, known
        stack = jnp.concatenate([memory[1:], obs.flat[None]])
        return self.answer(stack), stack

    def answer(self, stack: Float[Array, "frames n_obs"]) -> Action:
        """Returns the action for a stack of observations, oldest first."""
        inputs = (stack - self.tensors["statistics.mean"]) / self.tensors["statistics.std"]
        inputs, body = jnp.clip(inputs, -_CLIP, _CLIP), "policy"
        if self.image is not None:
            begin, end = self.image_at, self.image_at + self.image[0] * self.image[1]
            seen = glance(self.tensors, "policy", stack[:, begin:end], self.image)
            inputs, body = jnp.concatenate([inputs[:, :begin], inputs[:, end:], seen], axis=-1), "policy.body"
        parameters = perceptron(self.tensors, body, inputs.reshape(-1), jax.nn.swish)
        n_action = len(self.low)
        no_estimate = jnp.array([0.0, 0.0, jnp.nan, 0.0, 0.0])
        return no_estimate.at[:n_action].set(squash(parameters[:n_action], self.low, self.high))


@struct.dataclass
class RecurrentMemory:
    """Memory of a recurrent policy.

    Attributes:
        hidden: Hidden state of the GRU.
        reckoning: Dead reckoning and counted rings since the start.
    """

    hidden: Float[Array, "hidden"]
    reckoning: senses.Reckoning


@struct.dataclass
class Recurrent(Trained):
    """A GRU with an estimation head, which drives towards a goal and says where it is.

    Attributes:
        tensors: Layers `memory.Dense_0` and `memory.Dense_1`, matrix `memory.recurrent`, layer `estimate`, and layers
            `policy.hidden_<i>`.
        low: Smallest action, m/s and rad/s.
        high: Largest action, m/s and rad/s.
        bin_width: Width of a bin of the estimation head, m.
        shown: Choice of the network's inputs.
        image: Rows and columns of the scan of a LiDAR in three dimensions that it sees; None without one.
        name: Name on the leaderboard.
        conditions: Conditions of its training; None: any.
    """

    kind: ClassVar[str] = "gru"
    uses_lidar = True
    tensors: Tensors
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    bin_width: float = struct.field(pytree_node=False)
    shown: senses.Senses = struct.field(pytree_node=False, default=senses.PLAIN)
    image: tuple[int, int] | None = struct.field(pytree_node=False, default=None)
    name: str = struct.field(pytree_node=False, default="ppo-gru")
    conditions: Conditions | None = struct.field(pytree_node=False, default=None)

    @classmethod
    def of_layout(cls, layout: Mapping[str, Any], **common: Any) -> "Recurrent":
        """Makes the agent of a layout with `bin_width`, and `senses`, `tracker`, `boxes` and `image` if need be."""
        if (version := int(layout.get("senses", 1))) != senses.VERSION:
            raise ValueError(f"made for senses of version {version}, this release has {senses.VERSION}; train it anew")
        shown = senses.Senses(str(layout.get("tracker", "loop")), bool(layout.get("boxes", False)))
        image = tuple(layout["image"]) if layout.get("image") else None
        return cls(**common, bin_width=float(layout["bin_width"]), shown=shown, image=image)

    def try_out(self) -> None:
        """Answers one observation, by shapes alone."""
        zero, ranges = jnp.zeros(()), jnp.zeros(self.n_beams)
        entries = {} if self.image is None else {"scan": jnp.zeros(self.image[0] * self.image[1])}
        seen = Observed(ranges, ranges, distance=zero, heading=zero, goal=zero, ring_pitch=zero, entries=entries)
        jax.eval_shape(self.answer, self.blank(), seen, zero)

    def check_task(self, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
        """Refuses a task without a goal to stop at, and other beams or images."""
        if env.rule.errand not in ("stop", "return"):
            raise PolicyError(f"{source}: a policy that drives to a goal and stops, which {env.id} does not ask for")
        wanted, made_for = n_ranges(params), self.n_beams
        if wanted != made_for:
            raise PolicyError(f"{source}: made for {made_for} beams, {env.id} has {wanted}")
        if (image := env.images(params).get("scan")) != self.image:
            raise PolicyError(f"{source}: made for images of shape {self.image}, {env.id} has {image}")

    @property
    def n_features(self) -> int:
        """Number of the network's inputs beside an image."""
        glance = 0 if self.image is None else self.tensors["memory.glance.kernel"].shape[1]
        return self.tensors["memory.Dense_0.kernel"].shape[0] - glance

    @property
    def n_beams(self) -> int:
        """Number of beams of the planar scans that it was trained on."""
        return self.shown.n_beams(self.n_features)

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> RecurrentMemory:
        """Returns an empty memory."""
        del key, obs, params
        return self.blank()

    def blank(self) -> RecurrentMemory:
        """Returns the memory before the first step."""
        hidden = jnp.zeros(self.tensors["memory.recurrent"].shape[0])
        return RecurrentMemory(hidden, senses.start((), self.n_beams, self.shown))

    def act(
        self, key: PRNGKeyArray, memory: RecurrentMemory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, RecurrentMemory]:
        """Returns the action of one control period, and the memory after it."""
        del key, known
        return self.answer(memory, obs, told_start(obs, params))

    def answer(self, memory: RecurrentMemory, obs: Observed, start: Float[Array, ""]) -> tuple[Action, RecurrentMemory]:
        """Returns action and memory, from the observation and the believed start (m)."""
        parts = {
            "ranges": obs.ranges,
            "odometry": jnp.stack([obs.distance, obs.heading]),
            "goal": jnp.atleast_1d(obs.goal),
            "ring_pitch": jnp.atleast_1d(obs.ring_pitch),
            "flag": jnp.atleast_1d(obs.flag),
        }
        sight = senses.look(parts, start, memory.reckoning)
        hidden = self._update_hidden(memory.hidden, self._with_image(sight.features, obs))
        error, log_sigma = self._estimate(hidden)
        aim = senses.aim(sight.ahead - error, log_sigma)
        parameters = perceptron(self.tensors, "policy", jnp.concatenate([hidden, aim]), jax.nn.swish)
        action = squash(parameters[:2], self.low, self.high)
        after = RecurrentMemory(hidden, senses.advance(sight.reckoning, action, False))
        # The estimate is asked for the end of this control period.
        direction = 1.0 - 2.0 * sight.reckoning.back
        station = start + sight.station + error + direction * senses.PERIOD * jnp.maximum(action[0], 0.0)
        return jnp.stack([action[0], action[1], station, log_sigma, direction]), after

    def _with_image(self, features: Float[Array, "n"], obs: Observed) -> Float[Array, "m"]:
        """Returns the features with what the network sees of the scan."""
        if self.image is None:
            return features
        return jnp.concatenate([features, glance(self.tensors, "memory", obs.entries["scan"], self.image)])

    def _update_hidden(self, before: Float[Array, "hidden"], features: Float[Array, "n"]) -> Float[Array, "hidden"]:
        """Returns the hidden state one step later."""
        encoded = jax.nn.swish(dense(self.tensors, "memory.Dense_0", features))
        from_input = jnp.split(dense(self.tensors, "memory.Dense_1", encoded), 3)
        from_hidden = jnp.split(before @ self.tensors["memory.recurrent"], 3)
        reset = jax.nn.sigmoid(from_input[0] + from_hidden[0])
        update = jax.nn.sigmoid(from_input[1] + from_hidden[1] + 1.0)
        return update * before + (1.0 - update) * jnp.tanh(from_input[2] + reset * from_hidden[2])

    def _estimate(self, hidden: Float[Array, "hidden"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Estimates true less tracked distance, m, and the log of its standard deviation."""
        share = jax.nn.softmax(dense(self.tensors, "estimate", hidden))
        centres = senses.bin_centres(share.shape[-1], self.bin_width)
        error = jnp.sum(share * centres)
        variance = jnp.sum(share * jnp.square(centres - error))
        return error, 0.5 * jnp.log(variance + self.bin_width**2 / 12.0)
