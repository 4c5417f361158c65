"""The Unitree B2 learns to walk: settings, networks, scores, and the host's side of a run."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jaxtyping import Array, Bool, Float

from subterra_jax.b2.gait import WalkPolicy
from subterra_jax.b2.params import WalkParams
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.policies.files import GAIT
from subterra_jax.policies.network import Network, Shape
from subterra_jax.policies.trained import flat
from train import learning
from train.config import TrainConfig, check, known_preset
from train.driver import Driver, Policy
from train.learner import Learner
from train.log import LOG, print_table
from train.policies import write_tensors
from train.session import EVALUATION, Session
from train.snapshot import Snapshot
from train.world import library_versions


@dataclasses.dataclass(frozen=True)
class WalkConfig(TrainConfig):
    """Settings of PPO for the walking robot; `TrainConfig` says what each is. Steps are control periods of 20 ms.

    On a GPU two runs of one seed part unless `sums` are `ordered`: MJX adds up by scattering.
    """

    steps: int = 150_000_000
    n_envs: int = 8192
    unroll: int = 24
    epochs: int = 4
    minibatches: int = 32
    init_std: float = 0.3
    learning_rate: float = 1e-3
    max_grad_norm: float = 1.0
    discount: float = 0.98
    entropy_weight: float = 5e-3
    value_weight: float = 0.5
    stop_coverage: float = 2.0
    hidden: tuple[int, ...] = (512, 256, 128)
    target_kl: float = 0.01
    checkpoint_every: int = 100
    sums: Literal["ordered", "any"] = "any"

    # Pushes and commands make the rolling hundred too noisy to choose by.
    KEEPS_BEST: ClassVar[bool] = False


_PRESETS: dict[str, dict[str, Any]] = {
    "gpu": {},
    # Shows that it learns, not how well: a hundredth of the steps.
    "cpu": {"steps": 2_000_000, "n_envs": 256, "minibatches": 8, "hidden": (128, 128), "checkpoint_every": 20},
}


def make_walk_config(preset: str) -> WalkConfig:
    """Returns the settings for one kind of machine.

    Raises:
        ConfigError: There is no preset of that name.
    """
    known_preset(preset)
    return WalkConfig(**_PRESETS[preset])


@dataclasses.dataclass(frozen=True)
class WalkLayout:
    """Sizes of the walking robot's network."""

    shape: Shape  # Of the network: the actor sees the first `n_seen` numbers of the observation, the critic all

    def to_json(self) -> dict[str, Any]:
        """Returns the layout as a policy's file holds it."""
        return dataclasses.asdict(self)


class WalkDriver(Driver):
    """Drives legs: the inputs are the observation, in standard deviations from its mean."""

    kind = GAIT

    def __init__(self, env: Any, params: Any, config: WalkConfig, n_seen: int) -> None:
        bounds = env.action_space(params)
        n = env.observation_size(params)
        shape = Shape(n, len(bounds.low), tuple(config.hidden), init_std=config.init_std, n_seen=n_seen)
        self.env, self.layout = env, WalkLayout(shape)  # type: ignore[assignment]  # a gait has no memory to lay out
        self._net, self._n = Network(shape), n
        self._low, self._high = jnp.asarray(bounds.low), jnp.asarray(bounds.high)
        self._standing = 0.0

    def start_statistics(self) -> learning.Statistics:
        """Returns statistics of no observation yet."""
        return learning.start_statistics((self._n,))

    @property
    def n_action(self) -> int:
        """Numbers of an action."""
        return self.layout.shape.n_action

    def see(self, observation: Array, env_state: Any) -> Array:
        """Returns the observation."""
        return observation

    def begin(self, policy: Policy, seen: Array, params: Any) -> Array:
        """Returns the observation, which is all that is kept."""
        return seen

    def take(self, policy: Policy, kept: Array, action: Array, seen: Array, params: Any) -> Array:
        """Returns the observation."""
        return seen

    def go_on(self, policy: Policy, kept: Array, action: Array, seen: Array, done: Array, params: Any) -> Array:
        """Returns the observation."""
        return seen

    def inputs(self, policy: Policy, kept: Array) -> Array:
        """Returns the observation in standard deviations from its mean."""
        return learning.normalize(kept, policy.statistics["mean"], policy.statistics["std"])

    def raw(self, inputs: Array, policy: Policy) -> Array:
        """Returns the observation that had these inputs."""
        return inputs * policy.statistics["std"] + policy.statistics["mean"]

    def target(self, env_state: Any, kept: Array, params: Any) -> Array:
        """Returns no target."""
        return jnp.zeros((kept.shape[0], 0))

    def tensors(self, policy: Policy) -> dict[str, np.ndarray]:
        """Returns the arrays that walking needs, by the names that `subterra_jax.b2.gait` knows."""
        seen = slice(0, self.layout.shape.n_seen)
        statistics = {name: values[seen] for name, values in policy.statistics.items()}
        tree = jax.device_get({"actor": policy.network["actor"], "statistics": statistics})
        return {name: np.asarray(leaf, np.float32) for name, leaf in flat(tree).items()}


def make_walk_learner(env: Any, params: Any, config: WalkConfig, n_seen: int) -> Learner:
    """Makes PPO whose critic sees the truth.

    Args:
        env: A walking environment whose observation ends with the truth.
        params: Its parameters.
        config: Settings.
        n_seen: Numbers of the observation that the policy sees.

    Raises:
        ConfigError: A setting makes no sense.
    """
    check(config)
    return Learner(env, WalkDriver(env, params, config, n_seen), config)


Act = Callable[[Float[Array, "robot obs"]], Float[Array, "robot 12"]]
_STRIDE = 0.4  # s, over which velocities are averaged: the trunk sways with every stride
_SETTLED = 1.0  # s, after which a start no longer counts


def walker(
    env: WalkEnv, act: Act, n_robots: int, n_steps: int, seed: int = 7
) -> Callable[[WalkParams], dict[str, Float[np.ndarray, "..."]]]:
    """Makes a function that walks robots for one episode each, pushed and commanded as its params say.

    Args:
        env: The environment; its observation is what `act` sees.
        act: Observations to actions.
        n_robots: Number of robots.
        n_steps: Control periods.
        seed: Seed of all draws.

    Returns:
        A function of params, whose result has every step's `velocity` and `asked` `(step, robot, 3)`, and `fall`,
        `over` (the episode had ended before it), `contact` and `effort` `(step, robot)`.
    """
    start_key, walk_key = jax.random.split(jax.random.key(seed))
    begin, advance = jax.vmap(env.begin, in_axes=(0, None)), jax.vmap(env.advance, in_axes=(0, 0, 0, None))
    observe = jax.vmap(lambda state, params: env.observe(state, None, params), in_axes=(0, None))

    @jax.jit
    def run(params: WalkParams) -> dict[str, Array]:
        state = begin(env.draw_reset(start_key, (n_robots,), params), params)

        def step(carry: tuple[Any, Bool[Array, "robot"]], key: Array) -> tuple[Any, dict[str, Array]]:
            state, over = carry
            action = act(observe(state, params))
            noise = env.draw_step(key, (n_robots,), params)
            state, _, fallen, truncated, info = advance(state, action, noise, params)
            kept = {name: info[name] for name in ("velocity", "asked", "fall", "effort", "contact")}
            return (state, over | fallen | truncated), {**kept, "over": over}

        over = jnp.zeros(n_robots, bool)
        return jax.lax.scan(step, (state, over), jax.random.split(walk_key, n_steps))[1]

    return lambda params: {name: np.asarray(values) for name, values in run(params).items()}


def score(records: dict[str, np.ndarray], period: float) -> dict[str, float]:
    """Figures of what a `walker` tells.

    Returns:
        `falls` (fraction of robots that fell before the episode's end), `velocity_error` (m/s, mean distance in plan
        between velocity and command), `yaw_rate_error` (rad/s, mean absolute), both averaged over a stride of 0.4 s
        against the slewed command and from 1 s after the start, `contacts` (fraction of robots that touched a wall),
        `power` (W, mean mechanical), and `robots`.
    """
    alive = ~records["over"]
    width, first = round(_STRIDE / period), round(_SETTLED / period)
    error = _mean(records["velocity"] - records["asked"], width)[first:]
    whole = _mean(alive.astype(np.float32), width)[first:] > 0.999
    plan, turn = np.hypot(error[..., 0], error[..., 1]), np.abs(error[..., 2])
    return {
        "falls": float((records["fall"] & alive).any(axis=0).mean()),
        "velocity_error": float(plan[whole].mean()) if whole.any() else float("nan"),
        "yaw_rate_error": float(turn[whole].mean()) if whole.any() else float("nan"),
        "contacts": float((records["contact"] & alive).any(axis=0).mean()),
        "power": float(records["effort"][alive].mean()),
        "robots": int(alive.shape[1]),
    }


def _mean(values: Float[np.ndarray, "step ..."], width: int) -> Float[np.ndarray, "window ..."]:
    """Averages all windows of `width` steps."""
    total = np.cumsum(values, axis=0, dtype=np.float64)
    total = np.concatenate([np.zeros_like(total[:1]), total])
    return (total[width:] - total[:-width]) / width


FIGURE = "curve.png"


class WalkSession(Session):
    """The host's side of one run of a gait."""

    def score(self, snapshot: Snapshot, robots: int) -> dict[str, Any]:
        """Evaluates the policy and the bare trot, writes `evaluation.json`, and prints the scores."""
        env = dataclasses.replace(self.world.env, privileged=False)
        params, period = self.world.params, env.physics.period
        go = walker(env, self.policy(snapshot).act, robots, int(params.horizon))
        # Offsets of nothing leave the trot as it is.
        bare = dataclasses.replace(params, action_scale=jnp.zeros(3))
        found = {name: score(go(given), period) for name, given in (("policy", params), ("trot", bare))}
        self.folder.write_json(EVALUATION, {"schema": "subterra.evaluation/1", **self.world.facts, **found})
        table = {f"{name}, {who}": value for who, figures in found.items() for name, value in figures.items()}
        print_table(f"{self.world.task}, seed {self.learner.config.seed}: without exploration noise", table)
        return found

    def policy(self, snapshot: Snapshot) -> WalkPolicy:
        """Returns the policy as the package loads it."""
        return WalkPolicy(
            {name: jnp.asarray(tensor) for name, tensor in self.learner.driver.tensors(snapshot.policy).items()}
        )

    def release(self, out: Path, snapshot: Snapshot, found: dict[str, Any]) -> None:
        """Writes the policy and its facts."""
        config, driver = self.learner.config, self.learner.driver
        facts = {
            "task": self.world.task,
            "world": self.world.facts,
            "config": json.loads(json.dumps(dataclasses.asdict(config))),
            "iteration": snapshot.iteration,
            "steps": snapshot.iteration * config.steps_per_iteration,
            "versions": library_versions(),
            "scores": {**self.world.facts, **found},
        }
        write_tensors(out, driver.kind, driver.layout, driver.tensors(snapshot.policy), facts)
        print(out)

    def finish(self, snapshot: Snapshot) -> None:
        """Writes the last checkpoint and the curve."""
        if not self.folder.has(snapshot.iteration):
            self.folder.save(snapshot)
        draw(self.folder.path)


def draw(run: Path) -> None:
    """Draws a run's rewards and the length of its episodes against steps, `curve.png`."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    records = [json.loads(line) for line in (run / LOG).read_text().splitlines()]
    steps = [record["step"] / 1e6 for record in records]
    first = records[0] if records else {}
    names = sorted(name for name in first if name.startswith("reward_") and name != "reward_scale")
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4), layout="constrained")
    colours = pyplot.get_cmap("tab20")(np.arange(len(names)))  # there are more terms than usual colours
    for name, colour in zip(names, colours, strict=True):
        left.plot(
            steps,
            [record[name] * 50.0 for record in records],
            label=name.removeprefix("reward_"),
            color=colour,
            linewidth=1,
        )
    right.plot(steps, [record["length_mean_100"] for record in records], linewidth=1)
    left.set(xlabel="control periods, millions", ylabel="reward a second")
    right.set(xlabel="control periods, millions", ylabel="length of the last 100 episodes")
    left.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(run / FIGURE, dpi=110, metadata={"Software": None})
    pyplot.close(figure)
