"""Settings of a training run: frozen dataclasses, presets by task and machine, and checks before compiling."""

import dataclasses
import math
from typing import Any, ClassVar, Literal

from subterra_jax.host.errors import SubterraError
from subterra_jax.policies.memories import MEMORIES
from subterra_jax.tasks import TASKS

PRESETS = ("cpu", "gpu")


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


def fraction(config: Any, *names: str) -> None:
    """Raises `ConfigError` where one of the settings is no fraction."""
    for name in names:
        if not 0.0 <= getattr(config, name) <= 1.0:
            raise ConfigError(f"{name} must lie between 0 and 1, got {getattr(config, name)}")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Settings of PPO; a preset fills them in, the command line may change each."""

    seed: int = 0  # seed of everything random in the run
    steps: int = 1_500_000  # environment steps to train for, all environments together; rounded up to whole iterations
    # `none`; `stack`: the last `frames` observations; `gru`: a network that remembers; `along`: the learnt
    # localiser, which looks along the metres that it has passed; `map`: a histogram filter on the map
    memory: Literal["none", "stack", "gru", "along", "map"] = "none"
    frames: int = 1  # observations that the network sees at once
    cell: int = 128  # width of the GRU
    # Learn what only the simulator knows as well: with `gru` the error of the way to go, with `along` the true
    # station. It is a target and never an input.
    auxiliary: bool = False
    map_cell: float = 0.1  # length of a cell of the filter, m; for `map`. At 0.25 it misses the right place
    # policy whose weights are taken where they fit, by name, file or run folder: network, localiser
    begin_from: str | None = None
    n_envs: int = 128  # environments stepped together
    # steps of each environment in one iteration; with `gru`, the length of back-propagation through time
    unroll: int = 64
    epochs: int = 4  # passes over the data of one iteration
    minibatches: int = 4  # minibatches per pass; each holds whole unrolls of `n_envs / minibatches` environments
    hidden: tuple[int, ...] = (64, 64)  # widths of the hidden layers, of policy and value alike
    cruise: float | None = None  # largest speed of the policy, m/s; None is that of the vehicle
    standing: float = 0.5  # by how much of the largest speed the range of actions goes below 0, where a robot stands
    # standard deviation of the untrained policy before the tanh, in units of half the action range
    init_std: float = 0.5
    init_turn: float | None = None  # the same for the yaw rate; left out it is `init_std`
    # Largest standard deviation in the last iteration; the limit falls evenly on a logarithmic scale. A policy
    # drives by its mean, and that of a broad one stops short of where its draws do. None sets no limit.
    last_std: float | None = None
    learning_rate: float = 4e-4  # learning rate of Adam, at the start and at most
    last_rate: float = 1.0  # fraction of the learning rate that is left in the last iteration; it falls evenly
    # the learning rate falls where an update moves the policy further than about this divergence; 0 keeps it
    # constant
    target_kl: float = 0.0
    max_grad_norm: float = 0.5  # gradients are scaled down to this norm
    discount: float = 0.997  # per control period
    gae_lambda: float = 0.95  # mix of one-step and n-step advantages
    clip: float = 0.2  # half-width of the trust region of the probability ratio
    entropy_weight: float = 2e-3  # reward for randomness, in units of the loss
    value_weight: float = 0.5  # weight of the value loss
    auxiliary_weight: float = 0.1  # weight of the auxiliary loss of `gru`
    # errors of the command that the localiser compares: `match` of slip, `wide` of wet rail too
    front: Literal["match", "wide"] = "match"
    map: bool = False  # the localiser learns to take a map as well
    walls: bool = False  # show the network offset, half width and angle of the walls, as tracked, too
    drives: int = 32  # drives that the localiser learns from in one iteration
    drive_steps: int = 300  # steps of each
    drives_minibatch: int = 64  # drives in one step of the localiser's optimiser
    localiser_rate: float = 2e-3  # its learning rate, at most
    # training ends once the rolling-100 coverage is at least this (a fraction of the tunnel) and every one of those
    # episodes succeeded; a value above 1 never stops
    stop_coverage: float = 2.0
    stop_patience: int = 40  # for how many iterations in a row that must hold
    checkpoint_every: int = 50  # iterations between checkpoints; one is written at the end in any case
    # Parts that the environments are split into, each with draws of its own. As many devices as divide them share
    # them out; the result does not depend on how many those are.
    parts: int = 1
    # `ordered`: one seed gives one result on a GPU as well. `any`: a GPU adds up in any order.
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


# At least half a million transitions per iteration, or the launches of SGD cap the rate.
_GPU: dict[str, Any] = {
    "steps": 60_000_000,
    "n_envs": 8192,
    "epochs": 2,
    "minibatches": 8,
    "hidden": (128, 128),
    "checkpoint_every": 100,
}
# An iteration of a GRU costs the same launches however many robots there are.
_BY_MEMORY: dict[str, dict[str, Any]] = {
    "stack": {"steps": 200_000_000},
    "gru": {"steps": 300_000_000, "n_envs": 32_768, "unroll": 32, "minibatches": 8},
    "along": {
        "steps": 16_000_000,
        "n_envs": 2048,
        "minibatches": 4,
        "drives": 512,
        "drive_steps": 900,
    },
    # Every robot weighs thousands of cells a step; what is learnt is when to stop.
    "map": {"steps": 80_000, "n_envs": 128, "unroll": 32, "minibatches": 4, "learning_rate": 1e-4},
}
_COVER = {"stop_coverage": 0.9}
_GPU_COVER: dict[str, Any] = {"n_envs": 1024, "epochs": 4, "minibatches": 4, "hidden": (64, 64)}
# With a goal and few robots: who stands in half of the range and is not thrown against the walls stops by chance, and
# does not learn instead to end the way at a wall.
_STOP = {"init_turn": 0.1}
_CPU_GOAL: dict[str, Any] = {"steps": 4_000_000, "standing": 1.0, "last_rate": 0.05}
# Settings that some memories read and others do not.
_READ_BY: dict[str, tuple[str, ...]] = {
    "frames": ("stack", "along"),
    "cell": ("gru",),
    "auxiliary": ("gru", "along"),
    "auxiliary_weight": ("gru",),
    "map_cell": ("map",),
    "walls": ("along", "map"),
    **dict.fromkeys(("front", "map", "drives", "drive_steps", "drives_minibatch", "localiser_rate"), ("along",)),
}


def make_config(task: str, preset: str = "cpu", memory: str = "none") -> TrainConfig:
    """Returns the settings that are known to learn a task on one kind of machine.

    Args:
        task: Task id, `Subterra/StopAtShort-v1` say.
        preset: `cpu` or `gpu`.
        memory: Memory of the policy.

    Raises:
        ConfigError: There is no preset or memory of that name.
    """
    known_preset(preset)
    if memory not in MEMORIES:
        raise ConfigError(f"unknown memory {memory!r}; there are {', '.join(MEMORIES)}")
    settings: dict[str, Any] = {"memory": memory} | ({"frames": 4} if memory == "stack" else {})
    if preset == "gpu":
        settings |= {**_GPU, **_BY_MEMORY.get(memory, {})}
    if task in TASKS:
        covers = TASKS[task].rule.goal_kind == "cover"
        if covers:
            settings |= _COVER | (_GPU_COVER if preset == "gpu" else {})
        elif preset == "cpu":
            settings |= _CPU_GOAL
        if TASKS[task].rule.goal_kind == "stop":
            settings |= _STOP
    return TrainConfig(**settings)


def known_preset(preset: str) -> None:
    """Raises `ConfigError` where there is no preset of that name."""
    if preset not in PRESETS:
        raise ConfigError(f"unknown preset {preset!r}; there are {', '.join(PRESETS)}")


def check(config: TrainConfig) -> TrainConfig:
    """Refuses settings that make no sense, and returns the others.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    if not config.hidden or min(config.hidden) < 1:
        raise ConfigError(f"hidden must name at least one width, all at least 1, got {config.hidden}")
    at_least(config, 1, "steps", "n_envs", "unroll", "epochs", "minibatches", "parts", "frames", "cell")
    at_least(config, 1, "drives", "drive_steps", "drives_minibatch")
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
    if config.drives % config.parts:
        raise ConfigError(f"drives = {config.drives} cannot be divided into parts = {config.parts}")
    for name, memories in _READ_BY.items():
        if config.memory not in memories and getattr(config, name) != getattr(type(config), name):
            raise ConfigError(
                f"{name} = {getattr(config, name)} is for memory = {' or '.join(memories)}, "
                f"and memory = {config.memory} does not read it"
            )
    if config.memory == "along" and config.auxiliary and config.frames > 1:
        raise ConfigError(f"frames = {config.frames} is for a localiser that is given, and auxiliary = True learns it")
    if config.map and config.front != "match":
        raise ConfigError(f"map = True is for front = match, and front = {config.front}")
    positive(config, "map_cell", "localiser_rate", "learning_rate", "init_std", "max_grad_norm", "clip")
    not_negative(config, "standing", "entropy_weight", "value_weight", "auxiliary_weight", "stop_coverage", "target_kl")
    positive(config, *(name for name in ("init_turn", "last_std", "cruise") if getattr(config, name) is not None))
    fraction(config, "discount", "gae_lambda", "last_rate")
    return config
