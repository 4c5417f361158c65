"""Settings of a policy with memory: learnt by reward, or from a teacher."""

import dataclasses
from typing import Any, ClassVar

from subterra_jax.policies.senses import TRACKERS
from train.config import (
    ConfigError,
    TrainConfig,
    at_least,
    check_common,
    known_preset,
    not_negative,
    positive,
    share,
)


@dataclasses.dataclass(frozen=True)
class RecurrentConfig(TrainConfig):
    """Settings of PPO with a GRU and an estimation head; the learning rate falls to a tenth along a cosine.

    Attributes:
        hidden: Width of the GRU and of the layers around it.
        bins: Bins of the estimation head.
        bin_width: Their width, m.
        tracker: Ring counter, `loop` or `careful`; the second sees past boxes and is the default among them.
        estimate_weight: Weight of the estimation head's loss; with 0 reward alone teaches.
        begin_from: Policy to begin from, not from nothing: a run folder, a file, or the name of a released one. What a
            student has learnt from a teacher is made better by reward so.
        warm_up: Share of the training in which only the critic learns, where there is a policy to begin with.
        curriculum: Share of the training after which goals are as far away as the task has them.
        half: Keep images in 16 bits, and compute image and memory with bfloat16 numbers; a program much like it was 8 %
            faster on an H200 with `spin16x64`. A range of 2.5 m is then seen to 8 mm. The policy drives in 32 bits.
    """

    steps: int = 260_000_000
    n_envs: int = 16_384
    epochs: int = 2
    minibatches: int = 16
    max_grad_norm: float = 1.0
    discount: float = 0.99
    stop_coverage: float = 2.0  # the schedule of goals and learning rate runs to its end
    checkpoint_every: int = 20
    hidden: int = 256
    bins: int = 160
    bin_width: float = 0.125
    tracker: str | None = None
    estimate_weight: float = 0.5
    begin_from: str | None = None
    warm_up: float = 0.05
    curriculum: float = 0.4
    half: bool = False

    # Goals and learning rate follow the share of `steps` that is done.
    LIMITS: ClassVar[tuple[str, ...]] = ("checkpoint_every",)
    # Goals move away while it learns: who did best had the nearest.
    KEEPS_BEST: ClassVar[bool] = False


_PRESETS: dict[str, dict[str, Any]] = {
    "gpu": {},
    "cpu": {"steps": 30_000_000, "n_envs": 512, "hidden": 96, "minibatches": 8, "checkpoint_every": 10},
}
_STEPS = {"Subterra/StopAt-v1": 400_000_000}


def make_recurrent_config(task: str, preset: str = "gpu") -> RecurrentConfig:
    """Returns the settings for a task on one kind of machine.

    Args:
        task: Task id.
        preset: `cpu` or `gpu`.

    Raises:
        ConfigError: There is no preset of that name.
    """
    known_preset(preset)
    steps = {"steps": _STEPS[task]} if preset == "gpu" and task in _STEPS else {}
    return RecurrentConfig(**{**_PRESETS[preset], **steps})


def check_recurrent(config: RecurrentConfig) -> RecurrentConfig:
    """Refuses settings that make no sense, and returns the others.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    check_common(config)
    at_least(config, 1, "hidden")
    at_least(config, 3, "bins")
    positive(config, "bin_width")
    not_negative(config, "estimate_weight")
    if config.tracker is not None and config.tracker not in TRACKERS:
        raise ConfigError(f"tracker must be one of {', '.join(TRACKERS)}, got {config.tracker!r}")
    share(config, "curriculum", "warm_up")
    return config


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


_DISTILL_PRESETS: dict[str, dict[str, Any]] = {
    "gpu": {},
    "cpu": {"steps": 10_000_000, "n_envs": 256, "hidden": 96, "minibatches": 8},
}


def make_distill_config(task: str, preset: str = "gpu") -> DistillConfig:
    """Returns the settings for a task on one kind of machine.

    Raises:
        ConfigError: There is no preset of that name.
    """
    known_preset(preset)
    del task
    return DistillConfig(**_DISTILL_PRESETS[preset])


def check_distill(config: DistillConfig) -> DistillConfig:
    """Refuses settings that make no sense, and returns the others.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    check_recurrent(config)
    not_negative(config, "imitation_weight")
    share(config, "handover")
    return config
