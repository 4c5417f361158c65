"""Settings of a training run: frozen dataclasses, presets by task and machine, and checks before compiling."""

import dataclasses
import math
from typing import Any, ClassVar, Literal

from subterra_jax.b2.gait import RELEASED
from subterra_jax.host.errors import SubterraError
from subterra_jax.tasks import TaskError, find


class ConfigError(SubterraError, ValueError):
    """A setting, or a combination of settings, that no training run can have."""


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


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Settings that every kind of policy is trained with; a preset fills them in, the command line may change each.

    Attributes:
        seed: Seed of everything random in the run.
        steps: Environment steps to train for, all environments together; rounded up to whole iterations.
        n_envs: Environments stepped together.
        unroll: Steps of each environment in one iteration; with memory, the length of back-propagation through time.
        epochs: Passes over the data of one iteration.
        minibatches: Minibatches per pass; each holds whole unrolls of `n_envs / minibatches` environments.
        init_std: Standard deviation of the untrained policy before the tanh, in units of half the action range.
        min_std: Floor of that standard deviation.
        learning_rate: Learning rate of Adam, at the start and at most.
        max_grad_norm: Gradients are scaled down to this norm.
        discount: Per control period.
        gae_lambda: Mix of one-step and n-step advantages.
        clip: Half-width of the trust region of the probability ratio.
        entropy_weight: Reward for randomness, in units of the loss.
        value_weight: Weight of the value loss.
        stop_coverage: Training ends once the rolling-100 coverage is at least this (a share of the tunnel)
            and every one of those episodes succeeded; a value above 1 never stops.
        stop_patience: For how many iterations in a row that must hold.
        checkpoint_every: Iterations between checkpoints; one is written at the end in any case.
        parts: Parts that the environments are split into, each with draws of its own. As many devices as divide them
            share them out; the result does not depend on how many those are.
        sums: `ordered`: one seed gives one result on a GPU as well. `any`: a GPU adds up in any order, some 3 % faster.
    """

    seed: int = 0
    steps: int = 1_500_000
    n_envs: int = 128
    unroll: int = 128
    epochs: int = 4
    minibatches: int = 8
    init_std: float = 0.5
    min_std: float = 0.01
    learning_rate: float = 1e-3
    max_grad_norm: float = 0.5
    discount: float = 0.98
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy_weight: float = 1e-3
    value_weight: float = 0.5
    stop_coverage: float = 0.9
    stop_patience: int = 40
    checkpoint_every: int = 50
    parts: int = 1
    sums: Literal["ordered", "any"] = "ordered"

    # What may differ when a run goes on; nothing else may.
    LIMITS: ClassVar[tuple[str, ...]] = ("steps", "stop_coverage", "stop_patience", "checkpoint_every")
    # Whether a policy that once did best is kept although later ones do worse.
    KEEPS_BEST: ClassVar[bool] = True

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration, all environments together."""
        return self.n_envs * self.unroll

    @property
    def iterations(self) -> int:
        """Iterations that make up `steps`."""
        return math.ceil(self.steps / self.steps_per_iteration)

    @property
    def minibatch_envs(self) -> int:
        """Environments of one part in one minibatch."""
        return self.part_envs // self.minibatches

    @property
    def part_envs(self) -> int:
        """Environments of one part."""
        return self.n_envs // self.parts


@dataclasses.dataclass(frozen=True)
class PPOConfig(TrainConfig):
    """Settings of PPO with a multilayer perceptron.

    Attributes:
        hidden: Widths of the hidden layers, of policy and value alike.
        frames: Observations stacked into the input of the networks.
        target_kl: The learning rate falls where an update moves the policy further than about this divergence; 0 keeps
            it constant. Early on, all environments are at the same stage of their episode; a rate that rises freely
            then overfits the network to that stage.
    """

    hidden: tuple[int, ...] = (64, 64)
    frames: int = 4
    target_kl: float = 0.01


# Reward weights g = 100, c_d = 0.1, c_s = 0.01 are the environment's own defaults; only PPO's settings are here.
_PRESETS: dict[str, PPOConfig] = {
    "cpu": PPOConfig(),
    # At least a million transitions per iteration, or the launches of SGD cap the rate.
    "gpu": PPOConfig(
        steps=60_000_000,
        # More environments would not learn sooner: each has to drive the whole tunnel once before anyone succeeds.
        n_envs=4096,
        unroll=256,
        epochs=2,
        minibatches=32,
        hidden=(256, 256),
        stop_patience=20,
        checkpoint_every=20,
    ),
}
# What differs from that by task. T1 to T5 are here for comparison: without memory nobody passes the blind bound, and
# coverage does not say who has learnt them.
_GOAL = {"stop_coverage": 2.0}
_TASKS: dict[str, dict[str, dict[str, Any]]] = {
    "Subterra/Traverse-v1": {"cpu": {"steps": 4_000_000, "stop_patience": 60}, "gpu": {}},
    "Subterra/TraverseShort-v1": {"cpu": {}, "gpu": {"steps": 30_000_000}},
}
_OTHERS: dict[str, dict[str, Any]] = {
    "cpu": {**_GOAL, "steps": 4_000_000},
    "gpu": {**_GOAL, "steps": 130_000_000, "discount": 0.99},
}


def make_config(task: str, preset: str = "cpu") -> PPOConfig:
    """Returns the settings that are known to learn a task on one kind of machine.

    Args:
        task: Task id, `Subterra/TraverseShort-v1` say.
        preset: `cpu` or `gpu`.

    Raises:
        ConfigError: There is no preset of that name, or none for that task.
    """
    known_preset(preset)
    try:
        task = find(task)
    except TaskError as error:
        raise ConfigError(str(error)) from error
    different = _TASKS[task][preset] if task in _TASKS else _OTHERS[preset]
    return dataclasses.replace(_PRESETS[preset], **different)


def known_preset(preset: str) -> None:
    """Raises `ConfigError` where there is no preset of that name."""
    if preset not in _PRESETS:
        raise ConfigError(f"unknown preset {preset!r}; there are {', '.join(_PRESETS)}")


def check(config: PPOConfig) -> PPOConfig:
    """Refuses settings that make no sense, and returns the others.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    if not config.hidden or min(config.hidden) < 1:
        raise ConfigError(f"hidden must name at least one width, all at least 1, got {config.hidden}")
    at_least(config, 1, "frames")
    not_negative(config, "target_kl")
    check_common(config)
    return config


def check_common(config: TrainConfig) -> None:
    """Refuses settings that make no sense for any kind of policy.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    at_least(config, 1, "steps", "n_envs", "unroll", "epochs", "minibatches", "parts")
    at_least(config, 1, "stop_patience", "checkpoint_every")
    if config.seed < 0:
        raise ConfigError(f"seed must not be negative, got {config.seed}")
    if config.n_envs % config.minibatches:
        raise ConfigError(f"n_envs = {config.n_envs} cannot be divided into minibatches = {config.minibatches}")
    if config.n_envs % (config.minibatches * config.parts):
        raise ConfigError(
            f"n_envs = {config.n_envs} cannot be divided into parts = {config.parts} "
            f"of minibatches = {config.minibatches}"
        )
    positive(config, "learning_rate", "init_std", "max_grad_norm", "clip")
    not_negative(config, "entropy_weight", "value_weight", "stop_coverage")
    share(config, "discount", "gae_lambda")
    if not 0.0 < config.min_std < config.init_std:
        raise ConfigError(f"min_std must lie between 0 and init_std = {config.init_std}, got {config.min_std}")


@dataclasses.dataclass(frozen=True)
class Legs:
    """The trial on four legs after training.

    Attributes:
        gait: A file, the name of a released gait, or `trot`.
        robots: Number of robots; 0 leaves the trial out.
        engine: `mjx`, or `mujoco` in C on the host.
    """

    gait: str = RELEASED
    robots: int = 100
    engine: Literal["mjx", "mujoco"] = "mjx"
