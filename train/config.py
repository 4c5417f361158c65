"""What a training run is told: one frozen dataclass, presets by task and machine, and the checks before compiling."""

import dataclasses
import math

from train.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Settings of PPO; a preset fills them in and the command line may change each.

    Attributes:
        seed: Seed of everything random in the run.
        steps: Environment steps to train for, all environments together; rounded up to whole iterations.
        n_envs: Environments stepped together.
        unroll: Steps of each environment in one iteration.
        epochs: Passes over the data of one iteration.
        minibatches: Minibatches per pass; each holds whole unrolls of `n_envs / minibatches` environments.
        hidden: Widths of the hidden layers, of policy and value alike.
        frames: Observations stacked into the input of the networks.
        init_std: Standard deviation of the untrained policy before the tanh, in units of half the action range.
        min_std: Floor of that standard deviation.
        learning_rate: Of Adam, at the start and at most. Early on, all environments are at the same stage of their
            episode; a rate that rises freely then overfits the network to that stage.
        target_kl: The learning rate falls where an update moves the policy further than about this divergence; 0 keeps
            it constant.
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
    """

    seed: int = 0
    steps: int = 1_500_000
    n_envs: int = 128
    unroll: int = 128
    epochs: int = 4
    minibatches: int = 8
    hidden: tuple[int, ...] = (64, 64)
    frames: int = 4
    init_std: float = 0.5
    min_std: float = 0.01
    learning_rate: float = 1e-3
    target_kl: float = 0.01
    max_grad_norm: float = 0.5
    discount: float = 0.98
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy_weight: float = 1e-3
    value_weight: float = 0.5
    stop_coverage: float = 0.9
    stop_patience: int = 40
    checkpoint_every: int = 50

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
        """Environments in one minibatch."""
        return self.n_envs // self.minibatches


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
_TASKS: dict[str, dict[str, dict[str, float | int]]] = {
    "Subterra/Traverse-v0": {"cpu": {"steps": 4_000_000, "stop_patience": 60}, "gpu": {}},
    "Subterra/TraverseShort-v0": {"cpu": {}, "gpu": {"steps": 30_000_000}},
}


def make_config(task: str, preset: str = "cpu") -> PPOConfig:
    """The settings that are known to learn a task on one kind of machine.

    Args:
        task: Task id, `Subterra/TraverseShort-v0` say.
        preset: `cpu` or `gpu`.

    Raises:
        ConfigError: There is no preset of that name, or none for that task.
    """
    if preset not in _PRESETS:
        raise ConfigError(f"unknown preset {preset!r}; there are {', '.join(_PRESETS)}")
    if task not in _TASKS:
        raise ConfigError(f"no training preset for task {task!r}; there are presets for {', '.join(_TASKS)}")
    return dataclasses.replace(_PRESETS[preset], **_TASKS[task][preset])  # type: ignore[arg-type]


def check(config: PPOConfig) -> PPOConfig:
    """The settings themselves, once they are known to make sense.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    at_least_one = ("steps", "n_envs", "unroll", "epochs", "minibatches", "frames", "stop_patience", "checkpoint_every")
    for name in at_least_one:
        if getattr(config, name) < 1:
            raise ConfigError(f"{name} must be at least 1, got {getattr(config, name)}")
    if config.seed < 0:
        raise ConfigError(f"seed must not be negative, got {config.seed}")
    if config.n_envs % config.minibatches:
        raise ConfigError(f"n_envs = {config.n_envs} cannot be divided into minibatches = {config.minibatches}")
    if not config.hidden or min(config.hidden) < 1:
        raise ConfigError(f"hidden must name at least one width, all at least 1, got {config.hidden}")
    for name in ("learning_rate", "init_std", "max_grad_norm", "clip"):
        if not 0.0 < getattr(config, name) < math.inf:
            raise ConfigError(f"{name} must be positive, got {getattr(config, name)}")
    for name in ("target_kl", "entropy_weight", "value_weight", "stop_coverage"):
        if not 0.0 <= getattr(config, name) < math.inf:
            raise ConfigError(f"{name} must not be negative, got {getattr(config, name)}")
    for name in ("discount", "gae_lambda"):
        if not 0.0 <= getattr(config, name) <= 1.0:
            raise ConfigError(f"{name} must lie between 0 and 1, got {getattr(config, name)}")
    if not 0.0 < config.min_std < config.init_std:
        raise ConfigError(f"min_std must lie between 0 and init_std = {config.init_std}, got {config.min_std}")
    return config
