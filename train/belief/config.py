"""What a run is told in which the sensor of a histogram filter is learnt."""

import dataclasses
from typing import ClassVar

from subterra_jax.policies.belief import Habits
from train.checks import at_least, not_negative, positive, share
from train.config import TrainConfig, check_common, known_preset
from train.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class BeliefConfig(TrainConfig):
    """Settings; of PPO's own, neither advantage nor trust region, nor exploration, is used.

    Attributes:
        ways: Ways beside the true one that a lesson compares it with.
        least_apart: Ways nearer to the true one than this are no mistake, m.
        hidden: Widths of the network that weighs one beam.
        habits: How the filter keeps its belief and when it stops; not learnt, and written into the policy.
    """

    steps: int = 6_000_000
    n_envs: int = 128
    unroll: int = 128
    epochs: int = 4
    minibatches: int = 8
    learning_rate: float = 3e-3
    max_grad_norm: float = 1.0
    stop_coverage: float = 2.0
    checkpoint_every: int = 50
    ways: int = 127
    least_apart: float = 0.2
    hidden: tuple[int, ...] = (16,)
    habits: Habits = dataclasses.field(default_factory=Habits)

    KEEPS_BEST: ClassVar[bool] = False


_PRESETS: dict[str, dict[str, int]] = {
    "gpu": {},
    "cpu": {"steps": 400_000, "n_envs": 16, "unroll": 64, "epochs": 2, "minibatches": 2, "ways": 63},
}


def make_config(preset: str) -> BeliefConfig:
    """The settings for one kind of machine.

    Raises:
        ConfigError: There is no preset of that name.
    """
    known_preset(preset)
    return BeliefConfig(**_PRESETS[preset])  # type: ignore[arg-type]


def check(config: BeliefConfig) -> BeliefConfig:
    """The settings themselves, once they are known to make sense.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    check_common(config)
    at_least(config, 1, "ways")
    positive(config, "least_apart")
    if not config.hidden or min(config.hidden) < 1:
        raise ConfigError(f"hidden must name at least one width, all at least 1, got {config.hidden}")
    positive(config.habits, "cell", "sure_mass", "furthest")
    not_negative(config.habits, "drift", "lost_drift", "leak", "sure_for")
    share(config.habits, "sure_mass", "furthest", "leak")
    return config
