"""The task table: a Gymnasium id gives an environment and its params."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from subterra_jax.b2 import MISSIONS, WALK
from subterra_jax.env import TunnelEnv
from subterra_jax.faults import FaultParams
from subterra_jax.host.versions import no_task
from subterra_jax.lidar import LidarParams
from subterra_jax.obstacles import ObstacleParams
from subterra_jax.odometry import OdometryParams
from subterra_jax.reward import GoalRewardParams, RewardParams
from subterra_jax.rules import Relocalise, Rule, StopAt, Traverse, TurnBack
from subterra_jax.slip import SlipParams
from subterra_jax.state import EnvParams, GoalParams, StartParams
from subterra_jax.tunnel import CONTACT_REACH
from subterra_jax.tunnel.blocks import LIDAR_GAP
from subterra_jax.tunnel.sources import Source, resolve
from subterra_jax.vehicle import VehicleParams
from subterra_jax.wander import WanderParams

SHORT_LENGTH = 60.0
_SHORT_GOALS = {"low": 10.0, "high": 60.0, "margin": 5.0, "tolerance": 0.25}


@dataclasses.dataclass(frozen=True)
class Task:
    """One row of the task table.

    Attributes:
        rule: What it asks.
        horizon: Steps after which an episode is truncated.
        piece: Start and length of the piece of tunnel it happens in, m; None is the whole tunnel.
        parts: Fields of `EnvParams` beside those that every task has.
    """

    rule: Rule
    horizon: int
    piece: tuple[float, float] | None = None
    parts: dict[str, Any] = dataclasses.field(default_factory=dict)


def _parts(start: StartParams | None = None, goal: dict[str, Any] | None = None, **further: Any) -> dict[str, Any]:
    """What every task from T1 on has: slip, odometry that wanders, a goal and its reward."""
    return {
        "odometry": OdometryParams(wander=WanderParams(sigma=0.01), backward_bias_sigma=0.02),
        "reward": GoalRewardParams(),
        "slip": SlipParams(),
        "goal": GoalParams(**(goal or {})),
        **({} if start is None else {"start": start}),
        **further,
    }


# A goal of 60 m needs some tunnel behind it, and one who returns some behind the start.
_SHORT = (0.0, SHORT_LENGTH + 5.0)
_RETURN, _OFFSET = StartParams(station=5.0), StartParams(station=9.0, station_sigma=3.0)

TASKS: dict[str, Task] = {
    "Subterra/Traverse-v0": Task(Traverse(), 3000),
    "Subterra/TraverseShort-v0": Task(Traverse(), 600, (0.0, SHORT_LENGTH)),
    "Subterra/StopAt-v0": Task(StopAt(), 4000, parts=_parts()),
    "Subterra/StopAtShort-v0": Task(StopAt(), 1000, _SHORT, _parts(goal=_SHORT_GOALS)),
    "Subterra/StopAtOffset-v0": Task(StopAt(), 4000, parts=_parts(_OFFSET)),
    "Subterra/StopAtOffsetShort-v0": Task(StopAt(), 1000, _SHORT, _parts(_OFFSET, {**_SHORT_GOALS, "low": 20.0})),
    "Subterra/Return-v0": Task(TurnBack(), 8000, parts=_parts(_RETURN)),
    "Subterra/ReturnShort-v0": Task(TurnBack(), 2000, _SHORT, _parts(_RETURN, _SHORT_GOALS)),
    "Subterra/Obstructed-v0": Task(StopAt(), 4000, parts=_parts(obstacles=ObstacleParams())),
    "Subterra/ObstructedShort-v0": Task(StopAt(), 1000, _SHORT, _parts(goal=_SHORT_GOALS, obstacles=ObstacleParams())),
    "Subterra/Faulted-v0": Task(StopAt(), 4000, parts=_parts(faults=FaultParams())),
    "Subterra/FaultedShort-v0": Task(StopAt(), 1000, _SHORT, _parts(goal=_SHORT_GOALS, faults=FaultParams())),
    "Subterra/Relocalise-v0": Task(Relocalise(), 2000, parts=_parts()),
    "Subterra/RelocaliseShort-v0": Task(
        Relocalise(), 1000, _SHORT, _parts(goal={"tolerance": 0.25, "travel_max": 40.0})
    ),
}


def make(
    id: str,
    tunnel: Source | Sequence[Source] = None,
    lining: str | None = None,
    estimates: bool = False,
    **overrides: Any,
) -> tuple[Any, Any]:
    """Make an environment and its params.

    Args:
        id: A key of `TASKS`; or `Subterra/B2Walk-v0` or `Subterra/B2Traverse-v0`, for
            which `subterra_jax.b2.tasks.make` and `subterra_jax.b2.missions.make` say what else there is.
        tunnel: A tunnel file, a name as for `load_tunnel`, a plan from it, a list of such, of which each episode draws
            one, or a ready `Tunnel`, one or several, which is taken as it is, neither cut to the task's piece nor given
            another lining. None is the packaged tunnel.
        lining: Variant of the walls: `pockets` (as in the recorded bore), `smooth` or `furnished`. None is `pockets`,
            or the first where a tunnel has none.
        estimates: Let the action hold an estimate of the station and the log of its standard deviation as well: the
            estimation track. It does not move the robot; `info` tells its error.
        **overrides: Fields of `EnvParams` to replace: `horizon=100`, `lidar=LidarParams(range_sigma=0.0)`.

    Returns:
        The static environment (a `TunnelEnv`), and params whose every leaf is an array (`EnvParams`).

    Raises:
        ValueError: No such task, no such field, or a value that the simulator cannot honour.
        TunnelError: The tunnel file is unreadable or wrong, or has no such lining.
    """
    if id == WALK:
        from subterra_jax.b2 import tasks as walking  # MuJoCo is loaded only where physics is meant

        return walking.make(id, tunnel, lining, **overrides)  # type: ignore[arg-type]
    if id in MISSIONS:
        from subterra_jax.b2 import missions

        return missions.make(id, tunnel, lining, **overrides)  # type: ignore[arg-type]
    if id not in TASKS:
        raise ValueError(no_task(id, (*TASKS, WALK, *MISSIONS)))
    task = TASKS[id]
    fields: dict[str, Any] = {
        "vehicle": VehicleParams(),
        "lidar": LidarParams(),
        "odometry": OdometryParams(),
        "reward": RewardParams(),
        "start": StartParams(),
        "horizon": task.horizon,
        **task.parts,
    }
    known = {field.name for field in dataclasses.fields(EnvParams)} - {"tunnel"}
    if unknown := set(overrides) - known:
        raise ValueError(f"no field {sorted(unknown)} in EnvParams; there are {sorted(known)}")
    fields.update(overrides)
    _check(task.rule, fields)
    reach = float(np.max(fields["lidar"].range_max))
    params = EnvParams(tunnel=resolve(tunnel, lining, task.piece, reach), **fields)
    _check_length(id, params)
    return TunnelEnv(id=id, rule=task.rule, estimates=estimates), jax.tree.map(_as_array, params)


def _as_array(leaf: Any) -> jax.Array:
    """A leaf of the params as a 32-bit array; a weakly typed one would compile each function a second time."""
    leaf = jnp.asarray(leaf)
    return leaf.astype(jnp.int32 if jnp.issubdtype(leaf.dtype, jnp.integer) else jnp.float32)


def _check(rule: Rule, fields: dict[str, Any]) -> None:
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
    if rule.has_goal != (fields.get("goal") is not None):
        raise ValueError(f"goal must {'be' if rule.has_goal else 'not be'} GoalParams for this task")
    wanted = GoalRewardParams if rule.has_goal else RewardParams
    if not isinstance(fields["reward"], wanted):
        raise ValueError(f"reward must be {wanted.__name__} for this task, got {type(fields['reward']).__name__}")


def _check_length(id: str, params: EnvParams) -> None:
    """Refuse a tunnel in which the task has no room."""
    shortest = float(np.min(np.asarray(params.tunnel.length)))
    needed = 0.0 if params.goal is None else float(np.max(params.goal.low) + np.max(params.goal.margin))
    if shortest < needed:
        raise ValueError(f"{id} needs a tunnel of {needed:g} m, this one has {shortest:.1f} m")
