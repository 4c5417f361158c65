"""Our PPO with the preset of a machine, as `train.navigate` runs it."""

import dataclasses
from typing import Any

import numpy as np

import subterra_jax as st
from benchmarks.learning.curve import Curve
from train import ppo
from train.config import make_config
from train.run.snapshot import Snapshot

NAME = "ours"


def train(task: str, steps: int, seed: int, preset: str, tunnel: Any = None, **settings: Any) -> Curve:
    """Trains until the goal is met.

    Args:
        task: Task id.
        steps: Environment steps, at most.
        seed: Of everything.
        preset: `cpu` or `gpu`.
        tunnel: As for `st.make`.
        **settings: Of `PPOConfig`, in place of the preset's.
    """
    env, params = st.make(task, tunnel=tunnel)
    wanted = {"seed": seed, "steps": steps, "stop_patience": 1, **settings}
    config = dataclasses.replace(make_config(task, preset), **wanted)
    rows, timing = [], []

    def watch(now: Snapshot) -> None:
        rows.append(now.rows)
        told = now.record["timing"]
        timing.append((len(now.rows), told["seconds"] - told["compile_seconds"], told["compile_seconds"]))

    ppo.train(env, params, config, watch=watch)
    every = np.concatenate(rows)
    # Episodes that ended in one iteration come to the host together, at its end.
    seconds = np.concatenate([np.full(count, at) for count, at, _ in timing])
    name = f"{NAME}, {config.n_envs} environments"
    return Curve(name, every["step"], seconds, every["coverage"].astype(float), every["success"], timing[-1][2])
