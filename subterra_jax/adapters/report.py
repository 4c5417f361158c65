"""What a step tells, as one array of words: observation, reward, the two flags and info."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from subterra_jax.adapters.packing import pack
from subterra_jax.env import TunnelEnv
from subterra_jax.state import EnvParams


class Report(NamedTuple):
    """One step, or a batch of steps, told on the host.

    Attributes:
        obs: Observation, `(..., n_obs)`.
        reward: Reward, `(...)`.
        terminated: Whether the episode ended by what happened in it, `(...)`.
        truncated: Whether it ended at the horizon, `(...)`.
        info: The environment's own `info`.
    """

    obs: Any
    reward: Any
    terminated: Any
    truncated: Any
    info: dict[str, Any]


def step_and_pack(env: TunnelEnv, key: Any, state: Any, action: Any, params: EnvParams) -> tuple[jax.Array, Any]:
    """`env.step`, its report as words, and the state."""
    obs, state, reward, terminated, truncated, info = env.step(key, state, action, params)
    return pack(Report(obs, reward, terminated, truncated, info)), state


def shapes(env: TunnelEnv, params: EnvParams) -> tuple[Any, Report]:
    """Shapes and dtypes of a state and of a report, without computing either."""
    key = jax.random.key(0)
    _, state = jax.eval_shape(env.reset, key, params)
    action = jax.ShapeDtypeStruct((env.action_size,), np.float32)
    obs, _, reward, terminated, truncated, info = jax.eval_shape(env.step, key, state, action, params)
    return state, Report(obs, reward, terminated, truncated, info)


def python_reader(example: Report) -> Callable[[np.ndarray], Report]:
    """Words of one step to its report in Python's own floats, ints and bools; quicker than `unpacker`, leaf by leaf.

    Args:
        example: Shapes and dtypes of the report. Its leaves lie in the words as `pack` puts them: the observation, the
            reward, the flags, and info in the order of its names.
    """
    n_obs = example.obs.shape[0]
    entries, at = [], 3
    for name in sorted(example.info):
        leaf = example.info[name]
        entries.append((name, leaf.dtype.kind, slice(at, at + leaf.size) if leaf.ndim else at, leaf.shape))
        at += leaf.size
    scalars = [(name, kind, at) for name, kind, at, shape in entries if not shape]
    arrays = [(name, kind, at, shape) for name, kind, at, shape in entries if shape]

    def read(words: np.ndarray) -> Report:
        rest = words[n_obs:]
        real, whole = rest.view(np.float32).tolist(), rest.view(np.int32).tolist()
        info: dict[str, Any] = {
            name: real[at] if kind == "f" else bool(whole[at]) if kind == "b" else whole[at]
            for name, kind, at in scalars
        }
        for name, kind, at, shape in arrays:
            info[name] = (rest[at] != 0 if kind == "b" else rest[at].view(f"{kind}4")).reshape(shape)
        return Report(words[:n_obs].view(np.float32), real[0], bool(whole[1]), bool(whole[2]), info)

    return read
