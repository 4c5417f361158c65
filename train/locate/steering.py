"""Learns to steer by reward, among boxes: `python -m train.locate.steering LOCALISER --out DIR`.

PPO learns share of the speed and yaw rate from ranges and its own last commands. No command of a teacher, no lane and
no list of boxes is among its inputs. The mission stays written: how far it is to the goal says how fast to go at most.
While learning, the true station says that; in a policy, the localiser does.
"""

import dataclasses
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import safetensors.numpy
import tyro
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import observed
from subterra_jax.env import Box
from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_file, require_folder
from subterra_jax.policies import check_fits, load
from subterra_jax.policies.locate.agent import Locating, parted
from subterra_jax.policies.locate.steering import N_SIGHT, PREFIX, SHARE, YAW_RATE, sight, to_command
from train import tunnels
from train.config import ConfigError, PPOConfig, at_least, check
from train.feedforward.learner import Learner
from train.locate.keeping import POLICY
from train.policies import facts_file, policy_tensors
from train.session import Session
from train.world import World, library_versions

_KINDS = ("straight", "cast", "sprayed", "masonry")
_LEARNT = "where the robot is, and by reward how to steer; how fast to go at most and the stop are written"
# What a card tells of the localiser under the written steering does not hold for another steering.
_OF_THE_WRITTEN = ("scores", "measured", "success_against_time")


@struct.dataclass
class Steered:
    """State of a robot whose steering learns.

    Attributes:
        inner: State of the environment.
        command: Its last command, m/s and rad/s.
    """

    inner: Any
    command: Float[Array, "2"]


@dataclasses.dataclass(frozen=True)
class SteeringEnv:
    """A task with a goal, in which an action is a share of the speed, and a yaw rate.

    Attributes:
        env: The task.
    """

    env: Any

    @property
    def id(self) -> str:
        """Id of the task."""
        return self.env.id

    def observation_size(self, params: Any) -> int:
        """Returns the size of one observation."""
        del params
        return N_SIGHT

    def observation_space(self, params: Any) -> Box:
        """Returns the bounds of an observation: none."""
        del params
        return Box(np.full(N_SIGHT, -np.inf, np.float32), np.full(N_SIGHT, np.inf, np.float32))

    def action_space(self, params: Any) -> Box:
        """Returns the bounds of an action."""
        del params
        return Box(np.array([SHARE[0], -YAW_RATE], np.float32), np.array([SHARE[1], YAW_RATE], np.float32))

    def draw_reset(self, key: Any, batch: Any, params: Any) -> Any:
        """Draws the random numbers of resets."""
        return self.env.draw_reset(key, batch, params)

    def draw_step(self, key: Any, batch: Any, params: Any) -> Any:
        """Draws the random numbers of steps."""
        return self.env.draw_step(key, batch, params)

    def skips_unwanted(self, params: Any) -> bool:
        """Tells whether observations that nobody wants cost little."""
        return self.env.skips_unwanted(params)

    def begin(self, draws: Any, params: Any) -> Steered:
        """Begins an episode."""
        return Steered(self.env.begin(draws, params), jnp.zeros(2))

    def advance(self, state: Steered, action: Float[Array, "2"], noise: Any, params: Any) -> Any:
        """Takes one step but its observation."""
        to_go = state.inner.goal.station - state.inner.station
        most = jnp.clip(to_go / params.vehicle.period, 0.0, params.vehicle.speed_max)
        command = to_command(action, most)
        whole = jnp.pad(command, (0, self.env.action_size - 2))
        inner, *rest = self.env.advance(state.inner, whole, noise, params)
        return Steered(inner, command), *rest

    def observe(self, state: Steered, noise: Any, params: Any, wanted: Any = True) -> Array:
        """Returns what the steering reads."""
        flat = self.env.observe(state.inner, noise, params, wanted)
        return sight(observed(self.env, params, flat).ranges, state.command)


@dataclasses.dataclass(frozen=True)
class Command:
    """Learns to steer by reward, and writes a policy that localises and steers.

    Attributes:
        localiser: Localiser that the policy stops by, by name or file; it is not trained here.
        out: Run folder, with the policy beside its checkpoints.
        steering: Policy whose learnt steering is put beside the localiser, by name or file; nothing is trained then.
        task: Task with a goal ahead.
        tunnels: Tunnels to learn in.
        cache: Folder in which made tunnels are kept from run to run.
        resume: Go on from the newest checkpoint, or from the beginning.
        overwrite: Throw away the run that `out` holds.
        config: Settings of PPO.
    """

    localiser: tyro.conf.Positional[str]
    out: Path
    steering: str | None = None
    task: str = "Subterra/Obstructed-v1"
    tunnels: str = ",".join(f"open:{kind}:train:0-15" for kind in _KINDS)
    cache: Path | None = None
    resume: bool = False
    overwrite: bool = False
    config: tyro.conf.OmitArgPrefixes[PPOConfig] = dataclasses.field(
        default_factory=lambda: PPOConfig(
            steps=600_000_000,
            n_envs=8192,
            unroll=128,
            epochs=2,
            minibatches=32,
            hidden=(256, 256),
            frames=16,
            discount=0.99,
            stop_coverage=2.0,
            checkpoint_every=100,
        )
    )


def run(arguments: Command) -> None:
    """Trains, and writes the policy.

    Raises:
        ConfigError: A setting is wrong, `localiser` is none, or `steering` has none that was learnt.
        SubterraError: There is no such policy, task or tunnel, or the folder cannot be written.
    """
    agent, facts = load(arguments.localiser)
    if not isinstance(agent, Locating):
        raise ConfigError(f"{arguments.localiser}: is no localiser, but {type(agent).__name__}")
    if arguments.steering is None:
        facts, tensors, steered = learn(arguments, agent, facts)
    else:
        if (arguments.out / POLICY).exists() and not arguments.overwrite:
            raise ConfigError(f"{arguments.out / POLICY}: exists already; choose another --out, or say --overwrite")
        tensors, steered = borrow(arguments.steering)
    save(arguments.out / POLICY, agent, facts, tensors, steered)
    print(arguments.out / POLICY)


def learn(
    arguments: Command, agent: Locating, facts: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Returns the facts of the localiser under this task, the tensors of a steering that was trained, and its facts."""
    config = check(arguments.config)
    at_least(config, 1, "frames")
    names = tunnels.names_of(arguments.tunnels)
    env, params = tunnels.enter(arguments.task, tunnels.load(names, None, arguments.cache))
    if env.rule.errand != "stop":
        raise ConfigError(f"task must have a goal ahead to stop at; {env.id} asks to {env.rule.errand}")
    if facts.get("world", {}).get("sensor", tunnels.PLANAR) == tunnels.PLANAR:
        check_fits(agent, env, params, arguments.localiser)
    steered = SteeringEnv(env)
    world = World(env.id, steered, params, {"task": env.id, "tunnel": arguments.tunnels, "lining": None})
    learner = Learner(steered, params, config)
    last = Session(arguments.out, world, learner).train(resume=arguments.resume, overwrite=arguments.overwrite)
    if last is None:
        sys.exit(130)
    told = {"task": arguments.task, "tunnels": arguments.tunnels, "config": dataclasses.asdict(config)}
    return {**facts, **world.trained_under}, policy_tensors(learner.networks, last.policy), told


def borrow(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the tensors of the steering that a policy has learnt, and its facts.

    Raises:
        ConfigError: It has learnt none.
        PolicyError: There is no such policy.
    """
    other, facts = load(name)
    tensors = parted(other.tensors)[1] if isinstance(other, Locating) else {}
    if not tensors:
        raise ConfigError(f"{name}: has no steering that was learnt")
    return tensors, facts["steering"]


def save(path: Path, agent: Locating, facts: dict[str, Any], steering: dict[str, Any], steered: dict[str, Any]) -> None:
    """Writes a policy of a localiser's tensors and a steering's, and its facts.

    Args:
        path: The tensors' file; the facts go beside it.
        agent: The localiser.
        facts: Its facts.
        steering: Tensors of the steering.
        steered: What the steering was trained on: task, tunnels and settings.
    """
    named = {PREFIX + name: np.asarray(tensor, np.float32) for name, tensor in steering.items()}
    named |= {name: np.asarray(tensor, np.float32) for name, tensor in parted(agent.tensors)[0].items()}
    content = safetensors.numpy.save(dict(sorted(named.items())))
    whole = {
        **{name: value for name, value in facts.items() if name not in _OF_THE_WRITTEN},
        "name": f"{facts['name']}-steering",
        "task": steered["task"],
        "learnt": _LEARNT,
        "layout": {**facts["layout"], "frames": steered["config"]["frames"]},
        "tensors_sha256": hashlib.sha256(content).hexdigest(),
        "steering": {**steered, "localiser": facts["tensors_sha256"]},
        "versions": library_versions(),
    }
    require_folder(path.parent).mkdir(parents=True, exist_ok=True)
    for place, data in ((path, content), (facts_file(path), f"{json.dumps(whole, indent=1)}\n".encode())):
        with replace_file(place) as fresh:
            fresh.write_bytes(data)


def main() -> None:
    """Runs `python -m train.locate.steering`."""
    sys.exit(run_command(lambda: run(parse(_read))))


def _read(words: list[str]) -> Command:
    plain = (tyro.conf.FlagCreatePairsOff,)
    return tyro.cli(Command, args=words, prog="python -m train.locate.steering", description=__doc__, config=plain)


if __name__ == "__main__":
    main()
