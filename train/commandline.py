"""The command line of `train.navigate`; its defaults follow from the task, the memory, the teacher and the machine."""

import argparse
import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro

from train import policies
from train.b2.legs import Legs
from train.belief import config as belief_config
from train.belief.config import BeliefConfig
from train.config import PPOConfig, make_config
from train.devices import cluster
from train.devices.cluster import Cluster
from train.errors import ConfigError
from train.recurrent import config as recurrent_config
from train.recurrent import distill_config
from train.recurrent.config import RecurrentConfig
from train.recurrent.distill_config import DistillConfig

_DEFAULT_TASK = "Subterra/TraverseShort-v0"
_MEMORIES = ("none", "gru", "map")
_DESCRIPTION = """Trains a navigation policy; defaults follow from `--task`, `--memory`, `--teacher` and `--preset`.

python -m train.navigate --task Subterra/StopAtShort-v0 --memory gru --teacher oracle --out out/stop"""


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains a navigation policy; defaults follow from `--task`, `--memory`, `--teacher` and `--preset`.

    Attributes:
        out: Run folder to write: checkpoint/, config.json, log.jsonl, log.csv, episodes.csv, curve.*, evaluation.json.
        task: Task id.
        tunnel: Tunnel file, or a name: `subterra-351` (if left out), `metro-asbuilt`, `control`, `procedural:train:7`,
            `procedural:train:0-255`, of which each episode draws one.
        lining: Variant of the walls; `pockets` if left out, or the first where a tunnel has none.
        memory: `none`: a perceptron over a few observations. `gru`: a network that remembers; it learns by reward, or
            with `--teacher oracle` (any baseline, policy file or run folder) from a teacher. `map`: a belief over every
            place of a known tunnel, for Relocalise; what a scan says of a place is learnt.
        preset: `cpu` or `gpu`; what jax runs on if left out.
        seeds: Train these seeds at once, into `out/seed-<k>`, and draw them together.
        resume: Go on from the checkpoint in `out`.
        overwrite: Throw away the run that `out` holds.
        tensorboard: Write the log for TensorBoard as well.
        evaluation_episodes: Episodes of the evaluation after training, the first of the task's 500.
        embodiment: `scout`, the round robot of the tasks; or `b2`: learnt on a planar robot that obeys as late as the
            walking one does, then tried on four legs.
        legs: The trial of `--embodiment b2`.
        cluster: Other processes to train with.
        config: Settings of PPO.
    """

    out: Path
    task: str = _DEFAULT_TASK
    tunnel: Path | None = None
    lining: str | None = None
    memory: Literal["none", "gru", "map"] = "none"
    preset: str | None = None
    seeds: tuple[int, ...] = ()
    resume: bool = False
    overwrite: bool = False
    tensorboard: bool = False
    evaluation_episodes: int = 200
    embodiment: Literal["scout", "b2"] = "scout"
    legs: Legs = dataclasses.field(default_factory=Legs)
    cluster: Annotated[Cluster, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=Cluster)
    config: Annotated[PPOConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=PPOConfig)


@dataclasses.dataclass(frozen=True)
class RecurrentCommand(Command):
    """The same for a policy with memory."""

    config: Annotated[RecurrentConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(  # type: ignore[assignment]
        default_factory=RecurrentConfig
    )


@dataclasses.dataclass(frozen=True)
class DistillCommand(Command):
    """The same for a policy with memory that has a teacher."""

    config: Annotated[DistillConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(  # type: ignore[assignment]
        default_factory=DistillConfig
    )


@dataclasses.dataclass(frozen=True)
class BeliefCommand(Command):
    """The same for a policy that has the map and keeps a belief over it."""

    config: Annotated[BeliefConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(  # type: ignore[assignment]
        default_factory=BeliefConfig
    )


def read_command(arguments: list[str]) -> Command:
    """The command line, with the defaults of the task, memory and preset that it names itself.

    Raises:
        ConfigError: There is no such task, memory or preset.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--task", default=_DEFAULT_TASK)
    early.add_argument("--memory", default=_MEMORIES[0])
    early.add_argument("--teacher")
    early.add_argument("--preset")
    early.add_argument("--coordinator")
    early.add_argument("--processes", type=int)
    early.add_argument("--process", type=int)
    named, _ = early.parse_known_args(arguments)
    cluster.join(Cluster(named.coordinator, named.processes, named.process))
    preset = named.preset or ("cpu" if jax.default_backend() == "cpu" else "gpu")
    default = _default(named.task, named.memory, named.teacher, preset)
    return tyro.cli(
        type(default),
        args=arguments,
        default=default,
        prog="python -m train.navigate",
        description=_DESCRIPTION,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _default(task: str, memory: str, teacher: str | None, preset: str) -> Command:
    """The command for a task, with every setting filled in."""
    if memory not in _MEMORIES:
        raise ConfigError(f"unknown memory {memory!r}; there are {', '.join(_MEMORIES)}")
    if memory != "gru" and teacher is not None:
        raise ConfigError(f"teacher = {teacher} teaches a policy with memory; give --memory gru as well")
    config: Any
    if memory == "none":
        return Command(out=tyro.MISSING, preset=preset, config=make_config(task, preset))
    policies.known_task(task)
    if memory == "map":
        return BeliefCommand(out=tyro.MISSING, memory="map", preset=preset, config=belief_config.make_config(preset))
    if teacher is None:
        config = recurrent_config.make_config(task, preset)
        return RecurrentCommand(out=tyro.MISSING, memory="gru", preset=preset, config=config)
    config = distill_config.make_config(task, preset)
    return DistillCommand(out=tyro.MISSING, memory="gru", preset=preset, config=config)
