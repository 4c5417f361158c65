"""What trains with such settings on such a task, its teacher opened; before anything is compiled."""

from pathlib import Path
from typing import Any

from subterra_jax.baselines import registry
from subterra_jax.baselines.agent import Agent
from subterra_jax.policies import PolicyError, check_fits
from train import policies
from train.agents import weights_of
from train.belief import config as belief_config
from train.belief.config import BeliefConfig
from train.belief.learner import BeliefLearner
from train.config import PPOConfig, TrainConfig, check
from train.devices import spread
from train.devices.parts import Parts
from train.errors import CheckpointError, ConfigError
from train.evaluate import open_agent
from train.feedforward.learner import Learner
from train.recurrent import config as recurrent_config
from train.recurrent import distill_config
from train.recurrent.config import RecurrentConfig
from train.recurrent.distill import DistillLearner
from train.recurrent.distill_config import DistillConfig
from train.recurrent.layout import make_layout
from train.recurrent.learner import RecurrentLearner
from train.recurrent.network import RecurrentNetworks
from train.run.snapshot import Trainable


def checked(config: TrainConfig) -> None:
    """Refuses settings that make no sense, before the tunnel is opened.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    if isinstance(config, DistillConfig):
        distill_config.check(config)
    elif isinstance(config, RecurrentConfig):
        recurrent_config.check(config)
    elif isinstance(config, BeliefConfig):
        belief_config.check(config)
    else:
        assert isinstance(config, PPOConfig)
        check(config)


def make_learner(world: policies.World, config: TrainConfig, axes: tuple[str, ...] = ()) -> Trainable:
    """What trains with such settings.

    Raises:
        ConfigError: A setting makes no sense, no such network can learn this task, or no such teacher knows it.
    """
    spreads = config.parts > 1
    names: tuple[Parts, Parts] = ((spread.PART,), spread.SPLIT) if spreads else (axes, ())
    learner: Any
    if isinstance(config, DistillConfig):
        teacher = open_teacher(config.teacher, world)
        learner = DistillLearner(world.env, world.params, config, teacher, *names, begun=_begun(world, config))
    elif isinstance(config, RecurrentConfig):
        learner = RecurrentLearner(world.env, world.params, config, *names, begun=_begun(world, config))
    elif isinstance(config, BeliefConfig):
        learner = BeliefLearner(world.env, world.params, config, *names)
    else:
        assert isinstance(config, PPOConfig)
        learner = Learner(world.env, world.params, config, *names)
    return spread.Spread(learner) if spreads else learner


def _begun(world: policies.World, config: RecurrentConfig) -> dict[str, Any] | None:
    """Weights of the policy to begin with."""
    if config.begin_from is None:
        return None
    try:
        agent, _ = open_agent(Path(config.begin_from), None)
    except (PolicyError, CheckpointError) as error:
        raise ConfigError(f"begin_from = {config.begin_from}: {error}") from error
    networks = RecurrentNetworks(make_layout(world.env, world.params, config))
    return weights_of(networks, agent.tensors, config.begin_from)


def open_teacher(name: str, world: policies.World) -> Agent:
    """A baseline by its name, or a policy: released, or of a run folder.

    Raises:
        ConfigError: There is neither, or it cannot do this task.
    """
    if name in registry.names():
        return registry.make_agent(name, world.params)
    try:
        agent, _ = open_agent(Path(name), None)
        check_fits(agent, world.env, world.params, name)
    except (PolicyError, CheckpointError) as error:
        raise ConfigError(f"teacher = {name} is no baseline ({', '.join(registry.names())}): {error}") from error
    return agent
