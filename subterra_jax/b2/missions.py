"""The tasks that the B2 does on its legs, by id: an environment and its params."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp

from subterra_jax.b2 import MISSIONS, TRAVERSE, WALK
from subterra_jax.b2 import policy as gaits
from subterra_jax.b2.engine import MujocoPhysics, SceneWalk
from subterra_jax.b2.hierarchy import PERIODS, MissionEnv
from subterra_jax.b2.mission import MissionParams
from subterra_jax.b2.params import RandomisationParams, SensorParams
from subterra_jax.b2.physics import Physics
from subterra_jax.b2.policy import WalkPolicy
from subterra_jax.b2.tasks import as_arrays
from subterra_jax.b2.tasks import make as make_walk
from subterra_jax.lidar import LidarParams
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.odometry import OdometryParams
from subterra_jax.reward import RewardParams
from subterra_jax.rules import Traverse
from subterra_jax.state import EnvParams, StartParams
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.vehicle import VehicleParams

TROT = "trot"  # the gait as it is written down, without a trained policy
ENGINES = ("mjx", "mujoco")

# Five commands a second. A gait of its kind is asked for no more than it was trained for.
VEHICLE = VehicleParams(speed_max=0.8, yaw_rate_max=0.8, radius=0.4, period=0.2)
# All four feet on the track; no wider than the rails, no steeper than it would walk up to by itself.
START = StartParams(station=2.0, lateral=0.3, heading=0.1)
HORIZON = 4000


def make(
    id: str = TRAVERSE,
    tunnel: TunnelPlan | str | Path | None = None,
    lining: str | None = None,
    *,
    scene: str | Path | None = None,
    policy: WalkPolicy | str | Path = gaits.RELEASED,
    engine: Literal["mjx", "mujoco"] = "mjx",
    odometer: Literal["legs", "drift"] = "legs",
    relief: Relief | None = None,
    walk: dict[str, Any] | None = None,
    **overrides: Any,
) -> tuple[MissionEnv, MissionParams]:
    """Make a task of the B2 and its params.

    Args:
        id: One of `MISSIONS`.
        tunnel: As for the walking task: a file, a name or a plan; sleepers are laid by standard.
        lining: Variant of the walls; None is `pockets`, or the first where a tunnel has none.
        scene: A built scene folder, instead of `tunnel`. Its sleepers are walked on where they lie, and with
            `engine="mujoco"` the robot walks in `scene.xml` itself; the LiDAR sees all of its triangles.
        policy: The gait: a policy, its file or name, or `trot`.
        engine: `mjx`, for thousands on a GPU; or `mujoco`, in C on the host, for a few.
        odometer: As for `MissionEnv`.
        relief: What the LiDAR sees; that of the scene where there is one, if left out.
        walk: Fields of `WalkParams` to replace.
        **overrides: Fields of `EnvParams` to replace.

    Raises:
        ValueError: No such task, engine, odometer or field.
        TunnelError: The tunnel file is unreadable or wrong, or has no such lining.
        TrackError: The scene has no track.
        RobotError: The tunnel is narrower than the robot.
        PolicyError: There is no such gait, or it does not fit the robot.
    """
    for name, value, known in (("task", id, MISSIONS), ("engine", engine, ENGINES)):
        if value not in known:
            raise ValueError(f"no {name} {value!r}; there are {', '.join(known)}")
    if odometer not in ("legs", "drift"):
        raise ValueError(f"odometer must be 'legs' or 'drift', got {odometer!r}")
    # Nobody pushes the robot on its way.
    parts = {"randomisation": RandomisationParams(push=0.0), "sensor": SensorParams(), **(walk or {})}
    physics = MujocoPhysics() if engine == "mujoco" else Physics()
    walker, walking = make_walk(WALK, tunnel, lining, scene=scene, physics=physics, driven=True, **parts)
    if scene is not None:
        relief = relief or Relief.from_scene(scene, lining or "pockets")
        if engine == "mujoco":
            walker = SceneWalk.of(walker, Path(scene), lining)
    fields: dict[str, Any] = {
        "vehicle": VEHICLE,
        "lidar": LidarParams(fused=False),  # the kernels cast level beams only
        "odometry": OdometryParams(distance_bias_sigma=0.0 if odometer == "legs" else 0.02),
        "reward": RewardParams(),
        "start": START,
        "horizon": HORIZON,
    }
    known_fields = {field.name for field in dataclasses.fields(EnvParams)} - {"tunnel", "slip", "obstacles", "faults"}
    if unknown := set(overrides) - known_fields:
        raise ValueError(f"no field {sorted(unknown)} in a task of the B2; there are {sorted(known_fields)}")
    trained = _gait(policy, walker.observation_size(walking))
    params = MissionParams(tunnel=walking.tunnel, **(fields | overrides), walk=walking, policy=trained, relief=relief)
    told, period = PERIODS * physics.period, float(jnp.asarray(params.vehicle.period))
    if abs(period - told) > 1e-6:
        raise ValueError(f"the B2 is told every {told:g} s where to go, got period={period:g}")
    return MissionEnv(id=id, rule=Traverse(), walk=walker, odometer=odometer), as_arrays(params)


def _gait(policy: WalkPolicy | str | Path, size: int) -> WalkPolicy | None:
    """The gait, opened and checked; None for the trot."""
    if policy == TROT:
        return None
    if isinstance(policy, str | Path):
        source, (policy, _) = policy, gaits.load(policy)
    else:
        source = policy.name
    gaits.check_fits(policy, size, source)
    return policy
