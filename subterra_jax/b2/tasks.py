"""The tasks of the B2 by id: the walking task and the missions on a learnt gait, each as environment and params."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp

from subterra_jax.b2.gait import RELEASED, WalkPolicy, check_fits, load_policy
from subterra_jax.b2.mission import PERIODS, Legs
from subterra_jax.b2.model import B2
from subterra_jax.b2.params import RandomisationParams, WalkParams
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.constants import RANGE_MAX
from subterra_jax.host.task_ids import B2_TRAVERSE, MISSIONS, WALK
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.params import check_together, collect_entries, make_params
from subterra_jax.parts import Odometer, PlanarLidar, SpatialLidar
from subterra_jax.parts.odometer import OdometryParams
from subterra_jax.parts.spatial_lidar import SENSORS, SpatialParams, make_sensor
from subterra_jax.parts.unicycle import VehicleParams
from subterra_jax.physics.stage import Stage, settle
from subterra_jax.rules import StartParams, Traverse
from subterra_jax.state import EnvParams, as_arrays
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import load_tunnel, resolve
from subterra_jax.tunnel_env import TunnelEnv

TROT = "trot"  # the scripted gait, without a trained policy

# Five commands a second, within the velocities for which the gait was trained.
VEHICLE = VehicleParams(speed_max=0.8, yaw_rate_max=0.8, radius=0.4, period=0.2)
# All four feet on the track, between the rails, at no larger angle than the robot reaches by itself.
START = StartParams(station=2.0, lateral=0.3, heading=0.1)
HORIZON = 4000


def make(
    id: str = WALK,
    tunnel: TunnelPlan | str | Path | None = None,
    lining: str | None = None,
    *,
    scene: str | Path | None = None,
    engine: Literal["mjx", "mujoco"] = "mjx",
    driven: bool = False,
    privileged: bool = False,
    **overrides: Any,
) -> tuple[WalkEnv, WalkParams]:
    """Makes the walking environment and its params.

    Args:
        id: `Subterra/B2Walk-v1`.
        tunnel: A tunnel file, a name as for `load_tunnel`, or a plan; None is the packaged tunnel. The robot walks on
            its sleepers as measured, or on its floor where it has none.
        lining: Variant of the walls; None is `pockets`, or the first where a tunnel has none.
        scene: A built scene folder, whose tunnel is taken; instead of `tunnel`.
        engine: `mjx`, for thousands on a GPU; or `mujoco`, in C on the host, for a few: in `scene.xml` where there is a
            scene.
        driven: As for `WalkEnv`.
        privileged: As for `WalkEnv`.
        **overrides: Fields of `WalkParams` to replace.

    Raises:
        ValueError: No such task or field, or both a tunnel and a scene.
        TunnelError: The tunnel file is unreadable or wrong, or has no such lining.
        SubterraError: As `physics.stage.settle`.
    """
    if id != WALK:
        raise ValueError(f"no walking task {id!r}; there is {WALK}")
    plan = _load(tunnel, scene)
    return _walker(settle(B2, [plan], lining, scene, engine), plan, lining, overrides, driven, privileged)


def _walker(
    stage: Stage, plan: TunnelPlan, lining: str | None, fields: dict[str, Any], driven: bool, privileged: bool = False
) -> tuple[WalkEnv, WalkParams]:
    known = {field.name for field in dataclasses.fields(WalkParams)} - {"tunnel", "track"}
    if unknown := set(fields) - known:
        raise ValueError(f"no field {sorted(unknown)} in WalkParams; there are {sorted(known)}")
    params = WalkParams(tunnel=Tunnel.from_plan(plan, lining), track=stage.track, **fields)
    env = WalkEnv(physics=stage.engine, driven=driven, privileged=privileged)
    return env, as_arrays(params)


def _load(tunnel: TunnelPlan | str | Path | None, scene: str | Path | None) -> TunnelPlan:
    if scene is not None and tunnel is not None:
        raise ValueError(f"either a tunnel or a scene, got both {str(tunnel)!r} and {str(scene)!r}")
    if scene is not None:
        return load_tunnel(Path(scene) / "tunnel.npz")
    return tunnel if isinstance(tunnel, TunnelPlan) else load_tunnel(tunnel)


def make_mission(
    id: str = B2_TRAVERSE,
    tunnel: TunnelPlan | str | Path | None = None,
    lining: str | None = None,
    *,
    scene: str | Path | None = None,
    policy: WalkPolicy | str | Path = RELEASED,
    engine: Literal["mjx", "mujoco"] = "mjx",
    relief: Relief | None = None,
    walk: dict[str, Any] | None = None,
    sensor: Any = SENSORS[0],
    sweep: bool = False,
    **overrides: Any,
) -> tuple[TunnelEnv, EnvParams]:
    """Makes a planar task on the legs of the B2, and its params.

    Args:
        id: One of `MISSIONS`.
        tunnel: As for `make`.
        lining: As for `make`.
        scene: A built scene folder, instead of `tunnel`. The robot walks on its sleepers where they lie, and with
            `engine="mujoco"` in `scene.xml` itself; the LiDAR sees all of its triangles.
        policy: The gait: a policy, its file or name, or `trot`.
        engine: `mjx`, for thousands on a GPU; or `mujoco`, in C on the host, for a few.
        relief: Surface that the LiDAR sees; that of the scene, if any, if left out.
        walk: Fields of `WalkParams` to replace.
        sensor: The LiDAR on the trunk, as for `subterra_jax.make`.
        sweep: As for `subterra_jax.make`; refused, since the trunk's pose within a step is not kept.
        **overrides: Fields of `EnvParams` to replace.

    Raises:
        ValueError: No such task, engine or field.
        TunnelError: The tunnel file is unreadable or wrong, or has no such lining.
        SubterraError: As `physics.stage.settle`.
        PolicyError: There is no such gait, or it does not fit the robot.
    """
    if id not in MISSIONS:
        raise ValueError(f"no task {id!r}; there are {', '.join(MISSIONS)}")
    plan = _load(tunnel, scene)
    stage = settle(B2, [plan], lining, scene, engine)
    # No pushes on the way.
    own_walk = {"randomisation": RandomisationParams(push=0.0), **(walk or {})}
    walker, walking = _walker(stage, plan, lining, own_walk, driven=True)
    spatial = not (isinstance(sensor, str) and sensor == SENSORS[0])
    if spatial:
        made = sensor if isinstance(sensor, SpatialParams) else make_sensor(sensor)
        sweep |= overrides.setdefault("lidar", made).sweep
    if sweep:
        raise ValueError("sweep=True does not go with a robot on legs: it knows its trunk at the end of a step alone")
    if spatial:
        source = tunnel if scene is None else Path(scene) / "tunnel.npz"
        walking = dataclasses.replace(walking, tunnel=resolve(source, lining, None, RANGE_MAX, spatial=True))
    trained = _gait(policy, walker.observation_size(walking))
    own = {"walk": walking, "track": walking.track, "policy": trained, "relief": relief or stage.relief}
    legs = Legs(walk=walker)
    lidar = legs.carried(SpatialLidar() if spatial else PlanarLidar())
    env = TunnelEnv(id=id, rule=Traverse(), parts=(Odometer(), lidar), motion=legs)
    fields: dict[str, Any] = {
        "vehicle": VEHICLE,
        "odometry": OdometryParams(distance_sigma=0.0, distance_bias_sigma=0.0, heading_sigma=0.0),
        "start": START,
    }
    if given := set(own) & set(overrides):
        raise ValueError(
            f"{env.id} has no {sorted(given)} to replace; `tunnel=`, `walk=`, `policy=` and `relief=` make them"
        )
    horizon = overrides.pop("horizon", HORIZON)
    entries = stage.with_start(collect_entries(env, {**fields, **own, **overrides}), "start" in overrides)
    params = make_params(env, walking.tunnel, horizon, entries)
    check_together(env, params)
    _check_period(params, PERIODS * walker.physics.period)
    return env, params


def _check_period(params: EnvParams, commanded: float) -> None:
    """Refuse a control period other than that of the commands, s."""
    period = float(jnp.asarray(params.vehicle.period))
    if abs(period - commanded) > 1e-6:
        raise ValueError(f"the B2 takes a command every {commanded:g} s, got period={period:g}")


def _gait(policy: WalkPolicy | str | Path, size: int) -> WalkPolicy | None:
    if policy == TROT:
        return None
    source = policy.name if isinstance(policy, WalkPolicy) else policy
    trained = policy if isinstance(policy, WalkPolicy) else load_policy(policy)[0]
    check_fits(trained, size, source)
    return trained
