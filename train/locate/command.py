"""Tunnels, seeds and settings that a training of localisers is told, and which of them a run keeps when it goes on."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

import tyro

from subterra_jax.constants import SPEED_MAX
from subterra_jax.policies import PolicyError
from train import tunnels
from train.config import ConfigError, at_least, positive
from train.locate.learner import LocateConfig, LocateLearner
from train.sinks import check_tensorboard

_KINDS = ("straight", "cast", "sprayed", "masonry")


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains localisers, and scores them on drives in `val` on the way.

    Attributes:
        out: Folder with one `seed-<k>` for each seed (`policy.safetensors` and its facts, `log.jsonl`, `curve.jsonl`
            with scores on `val` against time, `scores.json`), with `config.json` and `checkpoint/`.
        task: Task that is driven, one that starts facing growing stations.
        sensor: The LiDAR, by name: `planar16`, or a spinning one as `spin16x64`.
        tunnels: Tunnels to learn in.
        val: Tunnels to score in.
        drives: Drives of the score, the same for every seed and network.
        seeds: Seeds of weights and drives, trained at once.
        cache: Folder in which made tunnels are kept from run to run.
        score_every: Time between two scores, s.
        save_every: Time between two checkpoints, s.
        resume: Go on from the newest checkpoint, or from the beginning.
        overwrite: Throw away the run that `out` holds.
        tensorboard: Write the log for TensorBoard as well.
        settings: YAML, TOML or JSON file with options, or a run's `config.json`; options override it.
        config: Settings.
    """

    out: Path
    task: str = "Subterra/StopAt-v1"
    sensor: str = tunnels.PLANAR
    tunnels: str = ",".join(f"open:{kind}:train:0-15" for kind in _KINDS)
    val: str = ",".join(f"open:{kind}:val:0-9" for kind in _KINDS)
    drives: int = 512
    seeds: tuple[int, ...] = (0,)
    cache: Path | None = None
    score_every: float = 15.0
    save_every: float = 60.0
    resume: bool = False
    overwrite: bool = False
    tensorboard: bool = False
    settings: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    config: Annotated[LocateConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=LocateConfig)


def check(arguments: Command) -> None:
    """Refuses settings that cannot be trained with.

    Raises:
        ConfigError: A number is out of range, a network unknown, a seed twice, or a library missing.
    """
    config = arguments.config
    at_least(config, 1, "n_envs", "minibatch", "chunk", "epochs")
    at_least(config, 200, "n_steps")
    positive(config, "learning_rate", "max_grad_norm", "minutes")
    for name in ("hidden", "wrong"):
        if not 0.0 <= getattr(config, name) < 1.0:
            raise ConfigError(f"{name} must be at least 0 and below 1, got {getattr(config, name)}")
    if config.map and arguments.sensor != tunnels.PLANAR:
        raise ConfigError(f"a map is of the walls in the plane of {tunnels.PLANAR}; {arguments.sensor} sees others")
    if config.speed is not None and not 0.0 < config.speed <= SPEED_MAX:
        raise ConfigError(f"speed must be above 0 and at most {SPEED_MAX} m/s, got {config.speed}")
    if config.n_envs % config.minibatch:
        raise ConfigError(f"n_envs = {config.n_envs} must be a multiple of minibatch = {config.minibatch}")
    at_least(arguments, 1, "drives")
    positive(arguments, "score_every", "save_every")
    if len(set(arguments.seeds)) != len(arguments.seeds) or not arguments.seeds or min(arguments.seeds) < 0:
        raise ConfigError(f"seeds must differ and be at least 0, got {' '.join(map(str, arguments.seeds)) or 'none'}")
    try:
        LocateLearner.check(config)
    except (ValueError, PolicyError) as error:
        raise ConfigError(str(error)) from error
    if arguments.tensorboard:
        check_tensorboard()


def identity(arguments: Command) -> dict[str, Any]:
    """Returns the settings that a run must keep when it goes on; the time may be another."""
    config = dataclasses.asdict(arguments.config)
    config.pop("minutes")
    plain = {
        "task": arguments.task,
        "sensor": arguments.sensor,
        "tunnels": arguments.tunnels,
        "seeds": list(arguments.seeds),
        **config,
    }
    return json.loads(json.dumps(plain))
