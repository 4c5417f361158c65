"""The task table: a Gymnasium id gives an environment and its params."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from subterra_jax.blocks import LIDAR_GAP
from subterra_jax.env import TraverseEnv
from subterra_jax.lidar import LidarParams
from subterra_jax.odometry import OdometryParams
from subterra_jax.plan import TunnelPlan
from subterra_jax.reward import RewardParams
from subterra_jax.state import EnvParams, StartParams
from subterra_jax.tunnel import CONTACT_REACH, Tunnel, resolve
from subterra_jax.vehicle import VehicleParams

SHORT_LENGTH = 60.0


@dataclasses.dataclass(frozen=True)
class Task:
    """One row of the task table.

    Attributes:
        horizon: Steps after which an episode is truncated.
        piece: Start and length of the piece of tunnel it happens in, m; None is the whole tunnel.
    """

    horizon: int
    piece: tuple[float, float] | None


TASKS: dict[str, Task] = {
    "Subterra/Traverse-v0": Task(horizon=3000, piece=None),
    "Subterra/TraverseShort-v0": Task(horizon=600, piece=(0.0, SHORT_LENGTH)),
}


def make(
    id: str,
    tunnel: Tunnel | TunnelPlan | str | Path | None = None,
    lining: str = "pockets",
    **overrides: Any,
) -> tuple[TraverseEnv, EnvParams]:
    """Make an environment and its params.

    Args:
        id: A key of `TASKS`.
        tunnel: A tunnel file, a plan from `load_tunnel`, or a ready `Tunnel`, which is taken as it is, neither cut to
            the task's piece nor given another lining. None is the packaged tunnel.
        lining: Variant of the walls: `pockets` (the default, as in the recorded bore), `smooth` or `furnished`.
        **overrides: Fields of `EnvParams` to replace: `horizon=100`, `lidar=LidarParams(range_sigma=0.0)`.

    Returns:
        The static environment, and params whose every leaf is an array.

    Raises:
        ValueError: No such task, no such field, or a value that the simulator cannot honour.
        TunnelError: The tunnel file is unreadable or wrong, or has no such lining.
    """
    if id not in TASKS:
        raise ValueError(f"no task {id!r}; there are {', '.join(TASKS)}")
    task = TASKS[id]
    fields: dict[str, Any] = {
        "vehicle": VehicleParams(),
        "lidar": LidarParams(),
        "odometry": OdometryParams(),
        "reward": RewardParams(),
        "start": StartParams(),
        "horizon": task.horizon,
    }
    known = {field.name for field in dataclasses.fields(EnvParams)} - {"tunnel"}
    if unknown := set(overrides) - known:
        raise ValueError(f"no field {sorted(unknown)} in EnvParams; there are {sorted(known)}")
    fields.update(overrides)
    _check(fields)
    reach = float(np.max(fields["lidar"].range_max))
    params = EnvParams(tunnel=resolve(tunnel, lining, task.piece, reach), **fields)
    return TraverseEnv(id=id), jax.tree.map(_as_array, params)


def _as_array(leaf: Any) -> jax.Array:
    """A leaf of the params as a 32-bit array; a weakly typed one would compile each function a second time."""
    leaf = jnp.asarray(leaf)
    return leaf.astype(jnp.int32 if jnp.issubdtype(leaf.dtype, jnp.integer) else jnp.float32)


def _check(fields: dict[str, Any]) -> None:
    """Refuse, with the value, what the simulator would otherwise get silently wrong."""
    n_beams, robot = fields["lidar"].n_beams, fields["vehicle"]
    if n_beams < 1:
        raise ValueError(f"n_beams must be at least 1, got {n_beams}")
    if not np.all((np.asarray(robot.radius) > 0.0) & (np.asarray(robot.radius) <= CONTACT_REACH)):
        raise ValueError(f"radius must be in (0, {CONTACT_REACH}] m, got {robot.radius}")
    if np.any(robot.radius - np.asarray(robot.speed_max) * robot.period < LIDAR_GAP - 1e-6):
        raise ValueError(
            f"radius {robot.radius} m less one step of {robot.speed_max} m/s for {robot.period} s must leave "
            f"{LIDAR_GAP} m between LiDAR and walls"
        )
