"""Settings with which the B2 learns to walk."""

import dataclasses
from typing import ClassVar

from train.config import PPOConfig, known_preset


@dataclasses.dataclass(frozen=True)
class WalkConfig(PPOConfig):
    """Settings of PPO for the walking robot; `PPOConfig` says what each is. Steps are control periods of 20 ms.

    Attributes:
        deterministic: One seed gives one result on a GPU as well. MJX adds up by scattering, which a GPU then does one
            after the other; two runs of one seed part otherwise.
    """

    steps: int = 150_000_000
    n_envs: int = 8192
    unroll: int = 24
    epochs: int = 4
    minibatches: int = 32
    init_std: float = 0.3
    min_std: float = 0.03
    learning_rate: float = 1e-3
    max_grad_norm: float = 1.0
    discount: float = 0.98
    entropy_weight: float = 5e-3
    value_weight: float = 0.5
    stop_coverage: float = 2.0
    hidden: tuple[int, ...] = (512, 256, 128)
    frames: int = 1
    checkpoint_every: int = 100
    deterministic: bool = False

    # Pushes and commands make the rolling hundred too noisy to choose by.
    KEEPS_BEST: ClassVar[bool] = False


_PRESETS: dict[str, dict[str, int | tuple[int, ...]]] = {
    "gpu": {},
    # Shows that it learns, not how well: a hundredth of the steps.
    "cpu": {"steps": 2_000_000, "n_envs": 256, "minibatches": 8, "hidden": (128, 128), "checkpoint_every": 20},
}


def make_config(preset: str) -> WalkConfig:
    """The settings for one kind of machine.

    Raises:
        ConfigError: There is no preset of that name.
    """
    known_preset(preset)
    return WalkConfig(**_PRESETS[preset])  # type: ignore[arg-type]
