"""What a recurrent training run is told."""

import dataclasses
import math

from train.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class RecurrentConfig:
    """Settings of PPO with a GRU and an estimation head.

    Attributes:
        seed: Seed of everything random in the run.
        steps: Environment steps to train for, all environments together; rounded up to whole iterations.
        n_envs: Environments stepped together.
        unroll: Steps of each environment in one iteration: the length of back-propagation through time.
        epochs: Passes over the data of one iteration.
        minibatches: Minibatches per pass, each of whole unrolls of some of the environments.
        hidden: Width of the GRU and of the layers around it.
        bins: Bins of the estimation head.
        bin_width: Their width, m.
        estimate_weight: Weight of the estimation head's loss; 0 leaves reward alone to teach.
        phase_weight: Weight of the loss of the phase between two rings.
        detour: Share of the training after which goals are as far away as the task has them.
        init_std: Standard deviation of the untrained policy before the tanh, in units of half the action range.
        min_std: Floor of that standard deviation.
        learning_rate: Of Adam, at the start; it falls to a tenth along a cosine.
        max_grad_norm: Gradients are scaled down to this norm.
        discount: Per control period.
        gae_lambda: Mix of one-step and n-step advantages.
        clip: Half-width of the trust region of the probability ratio.
        entropy_weight: Reward for randomness, in units of the loss.
        value_weight: Weight of the value loss.
    """

    seed: int = 0
    steps: int = 260_000_000
    n_envs: int = 16_384
    unroll: int = 128
    epochs: int = 2
    minibatches: int = 16
    hidden: int = 256
    bins: int = 160
    bin_width: float = 0.25
    estimate_weight: float = 0.5
    phase_weight: float = 1.0
    detour: float = 0.4
    init_std: float = 0.5
    min_std: float = 0.01
    learning_rate: float = 1e-3
    max_grad_norm: float = 1.0
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy_weight: float = 1e-3
    value_weight: float = 0.5

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration, all environments together."""
        return self.n_envs * self.unroll

    @property
    def iterations(self) -> int:
        """Iterations that make up `steps`."""
        return math.ceil(self.steps / self.steps_per_iteration)


def check(config: RecurrentConfig) -> RecurrentConfig:
    """The settings themselves, once they are known to make sense.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    for name in ("steps", "n_envs", "unroll", "epochs", "minibatches", "hidden", "bins"):
        if getattr(config, name) < 1:
            raise ConfigError(f"{name} must be at least 1, got {getattr(config, name)}")
    if config.n_envs % config.minibatches:
        raise ConfigError(f"n_envs = {config.n_envs} cannot be divided into minibatches = {config.minibatches}")
    for name in ("learning_rate", "init_std", "max_grad_norm", "clip", "bin_width"):
        if not 0.0 < getattr(config, name) < math.inf:
            raise ConfigError(f"{name} must be positive, got {getattr(config, name)}")
    for name in ("discount", "gae_lambda", "detour"):
        if not 0.0 <= getattr(config, name) <= 1.0:
            raise ConfigError(f"{name} must lie between 0 and 1, got {getattr(config, name)}")
    if not 0.0 < config.min_std < config.init_std:
        raise ConfigError(f"min_std must lie between 0 and init_std = {config.init_std}, got {config.min_std}")
    return config
