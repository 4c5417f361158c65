"""What a run is told in which a student with memory learns from a teacher."""

import dataclasses

from train.checks import not_negative, share
from train.recurrent import config as recurrent_config
from train.recurrent.config import RecurrentConfig


@dataclasses.dataclass(frozen=True)
class DistillConfig(RecurrentConfig):
    """Settings of distillation; of PPO's own, neither advantage nor trust region is used.

    Attributes:
        teacher: A baseline by name (`oracle` is told the truth), a released policy, or a run folder.
        handover: Share of the training after which the student drives every episode; until then more and more of them.
        imitation_weight: Weight of the distance between the student's action and the teacher's.
    """

    steps: int = 200_000_000
    n_envs: int = 4096  # more updates to the step than by reward: what a teacher says is hardly noise
    epochs: int = 1
    curriculum: float = 0.0
    teacher: str = "oracle"
    handover: float = 0.2
    imitation_weight: float = 1.0


_PRESETS: dict[str, dict[str, float | int]] = {
    "gpu": {},
    "cpu": {"steps": 10_000_000, "n_envs": 256, "hidden": 96, "minibatches": 8},
}


def make_config(task: str, preset: str = "gpu") -> DistillConfig:
    """The settings for a task on one kind of machine.

    Raises:
        ConfigError: There is no preset of that name.
    """
    recurrent_config.known_preset(preset)
    del task
    return DistillConfig(**_PRESETS[preset])  # type: ignore[arg-type]


def check(config: DistillConfig) -> DistillConfig:
    """The settings themselves, once they are known to make sense.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    recurrent_config.check(config)
    not_negative(config, "imitation_weight")
    share(config, "handover")
    return config
