"""The tasks that the B2 does on its legs, by id: an environment and its params."""

from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp

from subterra_jax.b2 import MISSIONS, TRAVERSE, WALK
from subterra_jax.b2 import policy as gaits
from subterra_jax.b2.engine import MujocoPhysics, SceneWalk
from subterra_jax.b2.mission import PERIODS, LegOdometer, Legs, TrunkLidar
from subterra_jax.b2.params import RandomisationParams, SensorParams
from subterra_jax.b2.physics import Physics
from subterra_jax.b2.policy import WalkPolicy
from subterra_jax.b2.tasks import make as make_walk
from subterra_jax.constants import DISTANCE_BIAS_SIGMA
from subterra_jax.env import TunnelEnv
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.parts import Odometer
from subterra_jax.parts.odometer import OdometryParams
from subterra_jax.parts.unicycle import VehicleParams
from subterra_jax.rules import StartParams, Traverse
from subterra_jax.state import EnvParams
from subterra_jax.tasks import collect_entries, make_params
from subterra_jax.tunnel.plan import TunnelPlan

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
) -> tuple[TunnelEnv, EnvParams]:
    """Make a task of the B2 and its params.

    Args:
        id: One of `MISSIONS`.
        tunnel: As for the walking task: a file, a name or a plan; sleepers are laid by standard.
        lining: Variant of the walls; None is `pockets`, or the first where a tunnel has none.
        scene: A built scene folder, instead of `tunnel`. Its sleepers are walked on where they lie, and with
            `engine="mujoco"` the robot walks in `scene.xml` itself; the LiDAR sees all of its triangles.
        policy: The gait: a policy, its file or name, or `trot`.
        engine: `mjx`, for thousands on a GPU; or `mujoco`, in C on the host, for a few.
        odometer: `legs`, the robot's own; or `drift`, the model of the planar tasks applied to its true motion.
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
    trained = _gait(policy, walker.observation_size(walking))
    own = {"walk": walking, "policy": trained, "relief": relief}
    env = TunnelEnv(
        id=id,
        rule=Traverse(),
        parts=(LegOdometer() if odometer == "legs" else Odometer(), TrunkLidar()),
        motion=Legs(walker),
    )
    fields: dict[str, Any] = {
        "vehicle": VEHICLE,
        "odometry": OdometryParams(distance_bias_sigma=0.0 if odometer == "legs" else DISTANCE_BIAS_SIGMA),
        "start": START,
    }
    if given := set(own) & set(overrides):
        raise ValueError(f"{env.id} has no {sorted(given)} to replace; `walk=`, `policy=` and `relief=` make them")
    horizon = overrides.pop("horizon", HORIZON)
    params = make_params(env, walking.tunnel, horizon, collect_entries(env, {**fields, **own, **overrides}))
    commanded, period = PERIODS * physics.period, float(jnp.asarray(params.vehicle.period))
    if abs(period - commanded) > 1e-6:
        raise ValueError(f"the B2 is told every {commanded:g} s where to go, got period={period:g}")
    return env, params


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
