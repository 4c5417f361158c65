"""Our own PPO, as `train.navigate` trains without memory."""

import dataclasses

import subterra_jax as st
from train import ppo
from train.config import make_config
from train.feedforward.learner import Learner
from train.others.watch import Watch
from train.policies import make_agent
from train.snapshot import Snapshot


def train(watch: Watch, steps: int, seed: int) -> None:
    """Trains until the watch says enough."""
    env, params = st.make(watch.task, **watch.options)
    config = dataclasses.replace(make_config(watch.task, "cpu"), steps=steps, seed=seed, stop_coverage=2.0)
    learner = Learner(env, params, config)

    def look(now: Snapshot) -> bool:
        return watch(
            now.iteration * config.steps_per_iteration, make_agent(learner.networks, learner.policy_of(now.state))
        )

    ppo.train(env, params, config, learner=learner, watch=look)
