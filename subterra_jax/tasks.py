"""The task table: a Gymnasium id gives an environment and its params; `register` adds a task of one's own."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from subterra_jax import constants as c
from subterra_jax.adapters import register_tasks
from subterra_jax.compiled import keep_programs
from subterra_jax.host.errors import SubterraError, TunnelError
from subterra_jax.host.loading import load_module
from subterra_jax.host.task_ids import BENCHMARK, MISSIONS, PLANAR, WALK, full_id, no_task
from subterra_jax.host.texture import check_dial
from subterra_jax.lidar import LidarParams
from subterra_jax.params import (
    check_length,
    check_robot,
    check_together,
    collect_entries,
    digest,
    make_params,
    task_figures,
)
from subterra_jax.parts import Faults, Imu, Obstacles, Odometer, Part, PlanarLidar, Slip
from subterra_jax.parts.odometer import OdometryParams
from subterra_jax.parts.slip import WanderParams
from subterra_jax.parts.spatial_lidar import SENSORS, SpatialLidar, SpatialParams, make_sensor
from subterra_jax.procedural import expand, open_world
from subterra_jax.rules import GoalParams, Relocalise, Rule, StartParams, StopAt, Traverse, TurnBack
from subterra_jax.rules.rule import GOAL_KINDS
from subterra_jax.state import EnvParams
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import Source, resolve
from subterra_jax.tunnel_env import TunnelEnv

PLAIN: tuple[Part, ...] = (Odometer(), PlanarLidar())
SLIPPING: tuple[Part, ...] = (*PLAIN, Slip())
PAPER_TUNNEL = "subterra-351"
N_TUNNELS = 12  # of the open world where none is named: every kind of every split is as often in them as any other
_QUICKLY_MADE = ("masonry",)  # kinds taken for a LiDAR in three dimensions where none is named: a second each
MOTIONS = ("wheels", "rover")  # of every planar task; the first is a unicycle
ROVER = MOTIONS[1]
OPTIONAL: tuple[Part, ...] = (Slip(), Obstacles(), Faults(), Imu())


class TaskError(SubterraError, ValueError):
    """There is no such task."""


@dataclasses.dataclass(frozen=True)
class Task:
    """One row of the task table."""

    rule: Rule  # rule of the task
    horizon: int  # steps after which an episode is truncated
    # start and length of the stretch of tunnel that the task happens in, m; None for the whole tunnel
    stretch: tuple[float, float] | None = None
    parts: tuple[Part, ...] = PLAIN  # sensors, errors and obstacles, in the order in which they act
    # entries of `EnvParams` that differ from the defaults of parts and rule
    params: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    tunnel: str | None = None  # tunnel where none is named; None for some of the open world


def _drifting(**params: Any) -> dict[str, Any]:
    """Params of every task from T1 on: an odometer whose error wanders and depends on the direction."""
    wander = WanderParams(sigma=c.ODOMETER_WANDER_SIGMA)
    return {"odometry": OdometryParams(wander=wander, backward_bias_sigma=c.BACKWARD_BIAS_SIGMA), **params}


_NEAR = GoalParams(low=c.SHORT_GOAL_LOW, high=c.SHORT_GOAL_HIGH, tolerance=c.SHORT_TOLERANCE)
_REPORT = GoalParams(margin=c.RELOCALISE_MARGIN, travel_max=c.RELOCALISE_TRAVEL)

TASKS: dict[str, Task] = {
    "Subterra/Traverse-v1": Task(Traverse(), c.HORIZON_TRAVERSE, tunnel=PAPER_TUNNEL),
    "Subterra/TraverseShort-v1": Task(Traverse(), c.HORIZON_TRAVERSE_SHORT, (0.0, c.SHORT_LENGTH), tunnel=PAPER_TUNNEL),
    "Subterra/StopAt-v1": Task(StopAt(), c.HORIZON_STOP, None, SLIPPING, _drifting()),
    "Subterra/StopAtShort-v1": Task(StopAt(), c.HORIZON_STOP_SHORT, None, SLIPPING, _drifting(goal=_NEAR)),
    "Subterra/Return-v1": Task(TurnBack(), c.HORIZON_RETURN, None, SLIPPING, _drifting()),
    "Subterra/Obstructed-v1": Task(StopAt(), c.HORIZON_STOP, None, (*SLIPPING, Obstacles()), _drifting()),
    "Subterra/Faulted-v1": Task(StopAt(), c.HORIZON_STOP, None, (*SLIPPING, Faults()), _drifting()),
    "Subterra/Relocalise-v1": Task(Relocalise(), c.HORIZON_RELOCALISE, None, SLIPPING, _drifting(goal=_REPORT)),
}


def list_tasks() -> tuple[str, ...]:
    """Return the ids that `make` takes: the ten of the benchmark, then those that were registered."""
    return tuple(dict.fromkeys((*BENCHMARK, *TASKS)))


def register(
    id: str,
    rule: Rule,
    *,
    like: str | None = None,
    horizon: int | None = None,
    stretch: tuple[float, float] | None = None,
    parts: Sequence[Part] | None = None,
    params: Mapping[str, Any] | None = None,
    tunnel: str | None = None,
) -> None:
    """Add a task, here and in Gymnasium. Adding it again under the same id replaces it.

    Args:
        id: Gymnasium id, `Namespace/Name-v1`.
        rule: Rule of the task.
        like: Id of a task that has what is not given here.
        horizon: Steps after which an episode is truncated; needed without `like`.
        stretch: Start and length of the stretch of tunnel that the task happens in, m; None for the whole tunnel.
        parts: Parts in the order in which they act: `PLAIN` (the default), `SLIPPING`, or parts of one's own.
        params: Entries of `EnvParams` that differ from the defaults of parts and rule, or from those of `like`.
        tunnel: Tunnel where none is named, as `subterra-351`; None for some of the open world.

    Raises:
        ValueError: The id belongs to the benchmark or has another form, the rule's goal kind is unknown, or the horizon
            is missing.
    """
    if id in BENCHMARK:
        raise ValueError(f"{id} is a task of the benchmark; register yours under another id")
    namespace, _, rest = id.partition("/")
    if not (namespace and "-v" in rest and rest.rpartition("-v")[2].isdigit()):
        raise ValueError(f"a task's id must read Namespace/Name-v1, got {id!r}")
    if not isinstance(rule, Rule):
        raise ValueError(f"{id}: rule must be a subterra_jax.rules.Rule, got {type(rule).__name__}")
    if rule.goal_kind not in GOAL_KINDS:
        raise ValueError(
            f"{id}: goal_kind must be one of {', '.join(GOAL_KINDS)}, {type(rule).__name__} has {rule.goal_kind!r}"
        )
    if horizon is None and like is None:
        raise ValueError(f"{id}: say horizon=STEPS, or like=ID of a task that has one")
    base = Task(rule, 0) if like is None else TASKS[find(like)]
    named = {"horizon": horizon, "stretch": stretch, "parts": None if parts is None else tuple(parts), "tunnel": tunnel}
    given: dict[str, Any] = {name: value for name, value in named.items() if value is not None}
    TASKS[id] = dataclasses.replace(base, rule=rule, params={**base.params, **(params or {})}, **given)
    if importlib.util.find_spec("gymnasium") is not None:
        register_tasks((id,))


def find(id: str, short: bool = False) -> str:
    """Return the id of a task; `MODULE:ID` and `FILE.py:ID` first run a user's module, which registers the task.

    Args:
        short: Take `StopAt` for `Subterra/StopAt-v1`, as command lines do.

    Raises:
        TaskError: There is no such task.
        UserCodeError: The module cannot be run.
    """
    if not isinstance(id, str):
        raise TaskError(f"a task is named by its id, as Subterra/StopAt-v1, got {id!r}")
    source, _, name = id.rpartition(":")
    if source:
        load_module(source)
    name = full_id(name) if short else name
    if name not in (known := list_tasks()):
        raise TaskError(no_task(name, known))
    return name


def make(
    id: str,
    tunnel: Source | Sequence[Source] = None,
    lining: str | None = None,
    estimates: bool = False,
    parts: Sequence[Part] = (),
    sensor: Any = SENSORS[0],
    sweep: bool = False,
    intensity: bool = False,
    doppler: bool = False,
    texture: float = 0.0,
    hidden_start: bool = False,
    split: str | None = None,
    motion: str = MOTIONS[0],
    **overrides: Any,
) -> tuple[Any, Any]:
    """Make an environment and its params.

    Args:
        id: A key of `TASKS`; `MODULE:ID` or `FILE.py:ID` for a task of one's own; or `Subterra/B2Walk-v1` or
            `Subterra/B2Traverse-v1`, whose further arguments `subterra_jax.b2.tasks.make` and `on_legs` say.
        tunnel: A tunnel file, a name as for `load_tunnel`, a plan from it, a list of such, of which each episode draws
            one, or a ready `Tunnel`, one or several, which is taken as it is, neither cut to the task's stretch nor
            given another lining. None is `open:train:0-11`, twelve tunnels of the open world, one of them an episode
            (with a LiDAR in three dimensions the shortest of each kind among the first hundred); `subterra-351` for
            the paper's task and the B2's.
        lining: Variant of the walls: `pockets` (as in the recorded bore), `smooth` or `furnished`. None is `pockets`,
            or the first where a tunnel has none.
        estimates: Let the action hold an estimate of the station and the log of its standard deviation as well: the
            estimation track. It does not move the robot; `info` tells its error.
        parts: Further parts, as sensors of one's own; their entries stand at the end of the observation.
        sensor: The LiDAR: `planar16`, the paper's; `spin16x64`, `vlp16`, `os1-64`, `avia` or unit vectors `(n, 3)`, in
            three dimensions, whose `scan` takes the place of `ranges`; or what `parts.make_sensor` returns.
        sweep: Cast each beam of a LiDAR in three dimensions from the pose at its own time.
        intensity: Observe the intensity of each return.
        doppler: Observe the speed of each range, of a LiDAR in three dimensions.
        texture: Dial of what intensities tell of the walls: from 0, all alike, to 1, an old, wet metro.
        hidden_start: The true start is off the reported one by a normal number of 3 m, cut off at three of them; for
            the tasks that report a start: `StopAt`, `StopAtShort`, `Return`, `Obstructed` and `Faulted`.
        split: In place of `tunnel`, those of another split of the open world: `train`, `val`, `test-seen` or
            `test-unseen`.
        motion: `wheels`, a unicycle that does what it is given; or `rover`, a Scout 2.0 with mass by physics in MJX,
            with the same observations, rewards and ends. Then `engine="mujoco"` computes it in MuJoCo's own C; `scene=`
            in place of `tunnel` names the folder of a built scene to do that in.
        **overrides: Entries of `EnvParams` to replace: `horizon=100`, `lidar=LidarParams(range_sigma=0.0)`. `slip`,
            `obstacles`, `faults` and `imu` bring their part to a task that lacks it.

    Returns:
        The static environment (a `TunnelEnv`), and params whose every leaf is an array (`EnvParams`). Compiled programs
        are kept on disk from here on, see `cache_programs`.

    Raises:
        ValueError: No such task, motion or entry, a motion that the task does not have, parts that do not go together,
            or a value that the simulator cannot honour.
        TunnelError: The tunnel file is unreadable or wrong, or has no such lining.
    """
    keep_programs()
    id = find(id)
    if motion not in MOTIONS or (motion != MOTIONS[0] and id not in TASKS):
        has = f"{', '.join(MOTIONS)}; a B2 drives {MISSIONS[0]}" if id in TASKS else "legs, and needs no word for it"
        raise ValueError(f"{id} has no motion {motion!r}; it has {has}")
    if id != WALK and (scene := overrides.get("scene")) is not None:
        if tunnel is not None:
            raise ValueError(f"either a tunnel or a scene, got both {str(tunnel)!r} and {str(scene)!r}")
        tunnel = scene
    if motion != ROVER and id in TASKS:
        overrides.pop("scene", None)
    if id in TASKS:
        tunnel = tunnel_for(id, tunnel, split, spatial=not is_planar(sensor))
    if hidden_start:
        overrides = {"start": _hidden_start(id, overrides), **overrides}
    if id == WALK or id in MISSIONS:
        from subterra_jax.b2 import tasks as walking  # MuJoCo is loaded only where physics is meant

        if split is not None or not isinstance(tunnel, str | Path | TunnelPlan | None):
            raise ValueError(f"{id} happens in one tunnel: give its name, its file or its plan")
        if id == WALK:
            _require_planar(id, sensor, sweep)
            return walking.make(tunnel, lining, **overrides)
    task = TASKS[id] if id in TASKS else Task(Traverse(), walking.HORIZON)
    spatial = not is_planar(sensor)
    check_dial(texture)
    channels: dict[str, Any] = {"intensity": intensity} if intensity else {}
    channels |= {"texture": texture} if texture else {}
    if spatial:
        made = sensor if isinstance(sensor, SpatialParams) else make_sensor(sensor)
        channels |= {"doppler": doppler or made.doppler, "sweep": sweep or made.sweep}
        overrides = {"lidar": dataclasses.replace(made, **channels), **overrides}
    else:
        _require_planar(id, sensor, sweep, doppler)
        overrides = {"lidar": LidarParams(**channels), **overrides} if channels else overrides
    own = [SpatialLidar() if spatial and isinstance(part, PlanarLidar) else part for part in task.parts]
    if wrong := [part for part in parts if not isinstance(part, Part)]:
        raise ValueError(f"parts must hold subterra_jax.parts.Part alone, got {wrong[0]!r}")
    named = {part.name for part in (*own, *parts)}
    brought = (part for part in OPTIONAL if part.name in overrides and part.name not in named)
    env = TunnelEnv(id=id, rule=task.rule, parts=(*own, *brought, *parts), estimates=estimates)
    horizon = _checked_horizon(overrides.pop("horizon", task.horizon))
    if motion == ROVER:
        from subterra_jax.physics import rolling  # MuJoCo is loaded only where physics is meant

        env, entries = rolling.on_rover(env, tunnel, lining, task.stretch, {**task.params, **overrides}, hidden_start)
    elif id in MISSIONS:
        env, entries = walking.on_legs(env, tunnel, lining, overrides)
    else:
        entries = collect_entries(env, {**task.params, **overrides})
    check_robot(entries)
    reach = c.RANGE_MAX if spatial else float(np.max(entries["lidar"].range_max))
    placed = resolve(tunnel, lining, task.stretch, reach, spatial)
    if entries["lidar"].texture is not None and np.any(np.asarray(placed.texture) < 0):
        raise TunnelError(f"{tunnel}: has no field 'texture', the seed of its walls' brightness: use texture=0")
    params = make_params(env, placed, horizon, entries)
    check_together(env, params)
    check_length(env, params)
    return env, params


def is_planar(sensor: Any) -> bool:
    """Tell whether a sensor, as `make` takes it, is the planar LiDAR."""
    return isinstance(sensor, str) and sensor == SENSORS[0]


def tunnel_for(
    id: str, tunnel: Source | Sequence[Source] = None, split: str | None = None, spatial: bool = False
) -> Any:
    """Return what `make` takes for the tunnel of a task.

    Args:
        tunnel: As for `make`.
        split: As for `make`.
        spatial: The LiDAR is one in three dimensions, whose surfaces take longer to make: short tunnels are taken.

    Raises:
        ValueError: There is no such split, or both a tunnel and a split are named.
    """
    if split is not None:
        if tunnel is not None:
            raise ValueError(f"either a tunnel or a split, got both {str(tunnel)!r} and {split!r}")
        if split not in open_world.SPLITS:
            raise ValueError(f"there is no split {split!r}; there are {', '.join(open_world.SPLITS)}")
    if tunnel is not None:
        return tunnel
    usual = TASKS[id].tunnel
    if usual is not None and split is None:
        return usual
    if spatial:
        return open_world.shortest("train", _QUICKLY_MADE) if split is None else open_world.shortest(split)
    return f"open:{split or 'train'}:0-{N_TUNNELS - 1}"


def first_tunnel(id: str, spatial: bool = False) -> str:
    """Return the first of the tunnels of a task where none is named, for what shows or measures a single one."""
    usual = tunnel_for(id, spatial=spatial) if id in TASKS else PAPER_TUNNEL
    return expand(usual)[0] if isinstance(usual, str) else usual[0]


def _hidden_start(id: str, overrides: Mapping[str, Any]) -> StartParams:
    """Return the start of a task whose true station is not the reported one."""
    if id not in TASKS or not isinstance(TASKS[id].rule, StopAt):
        able = ", ".join(name for name, task in TASKS.items() if isinstance(task.rule, StopAt))
        raise ValueError(f"{id} reports no start that could be hidden; these do: {able}")
    if "start" in overrides:
        raise ValueError("hidden_start and start exclude each other: start.station_sigma hides it too")
    return StartParams(station_sigma=c.HIDDEN_START_SIGMA)


def _checked_horizon(horizon: Any) -> Any:
    """Refuse a horizon that is no whole number of steps; what is traced has no value yet and is taken."""
    if isinstance(horizon, jax.core.Tracer):
        return horizon
    steps = np.asarray(horizon)
    if not np.issubdtype(steps.dtype, np.number) or not np.all((steps >= 1) & (steps == np.round(steps))):
        raise ValueError(f"horizon must be a whole number of steps, at least 1, got {horizon!r}")
    return horizon


def _require_planar(id: str, sensor: Any, sweep: bool, doppler: bool = False) -> None:
    """Refuse another LiDAR than the planar one, or what that lacks."""
    if not is_planar(sensor):
        raise ValueError(f"{id} has the sensor {SENSORS[0]!r} alone, got {sensor!r}")
    if sweep:
        raise ValueError(f"{SENSORS[0]!r} measures a scan at one instant: sweep=True needs a LiDAR in three dimensions")
    if doppler:
        raise ValueError(f"{SENSORS[0]!r} has no Doppler channel: doppler=True needs a LiDAR in three dimensions")


def constants_digest(env: TunnelEnv | None = None, params: EnvParams | None = None) -> str:
    """SHA-256 of the numbers that define the benchmark, or one task of it, whatever the tunnel.

    Args:
        env: An environment; None for all planar tasks with their default params, and the open world's kinds and splits.
    """
    if env is None or params is None:
        return _benchmark_digest()
    return digest(task_figures(env, params))


@functools.cache
def _benchmark_digest() -> str:
    figures: dict[str, Any] = {id: task_figures(*_without_tunnel(id, TASKS[id])) for id in PLANAR}
    return digest({**figures, "world": open_world.figures(), "hidden_start": c.HIDDEN_START_SIGMA})


def _without_tunnel(id: str, task: Task) -> tuple[TunnelEnv, EnvParams]:
    env = TunnelEnv(id=id, rule=task.rule, parts=task.parts)
    return env, make_params(env, (), task.horizon, collect_entries(env, task.params))
