"""One compiled step for all tests of the walking environment: MJX takes long to compile."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import pytest

import subterra_jax as st
from subterra_jax.b2 import constants as b2
from subterra_jax.b2.kinematics import standing_pose

N_ROBOTS = 8


def standing(model: mujoco.MjModel) -> mujoco.MjData:
    """A B2 in the default pose on a floor at z = 0, with the targets that hold it."""
    data = mujoco.MjData(model)
    pose, data.ctrl[:] = standing_pose()
    data.qpos[:] = [0.0, 0.0, b2.STAND_HEIGHT, 1.0, 0.0, 0.0, 0.0, *pose.tolist()]
    return data


@dataclasses.dataclass
class Walking:
    """A batch of robots in which finished ones begin anew."""

    env: Any
    params: Any
    batch: Any
    compiled: Any

    def reset(self, seed: int, params: Any = None):
        return self.compiled["reset"](jax.random.key(seed), self.params if params is None else params)

    def step(self, seed: int, state: Any, action: Any = None, params: Any = None):
        action = jnp.zeros((N_ROBOTS, 12)) if action is None else action
        return self.compiled["step"](jax.random.key(seed), state, action, self.params if params is None else params)

    def commanded(self, command, **further: Any):
        """Params under which one command holds for ever, without pushes and without noise or randomisation."""
        command = jnp.asarray(command, jnp.float32)
        fields = {"low": command, "high": command, "still": jnp.float32(0.0), "corridor": jnp.float32(10.0)}
        randomisation, sensor = self.params.randomisation, self.params.sensor
        calm = dataclasses.replace(randomisation, push=jnp.float32(0.0), friction=jnp.array([0.8, 0.8], jnp.float32))
        return dataclasses.replace(
            self.params,
            command=dataclasses.replace(self.params.command, **fields),
            randomisation=calm,
            sensor=jax.tree.map(jnp.zeros_like, sensor),
            **further,
        )


@pytest.fixture(scope="session")
def walking() -> Walking:
    env, params = st.make("Subterra/B2Walk-v1")
    batch = st.AutoReset(env)
    key, action = jax.random.key(0), jnp.zeros((N_ROBOTS, 12))
    # Compiling with less zeal: half the time, the same numbers to rounding.
    options = {"xla_backend_optimization_level": 0}
    reset = jax.jit(lambda key, params: batch.reset(key, params, N_ROBOTS)).lower(key, params).compile(options)
    _, state = reset(key, params)
    step = jax.jit(batch.step).lower(key, state, action, params).compile(options)
    return Walking(env, params, batch, {"reset": reset, "step": step})
