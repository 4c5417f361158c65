"""A planar task done on four legs: the B2's gait as a motion, its LiDAR and its odometer as parts.

Five times a second a driver commands `[v, ω]`; fifty times a second the gait obeys.
"""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import draws, observation
from subterra_jax.b2.kinematics import compose, rotate, standing_pose, yaw_quaternion
from subterra_jax.b2.params import Body, WalkParams, WalkResetNoise, WalkState, WalkStepNoise
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.lidar import LidarParams, cast
from subterra_jax.lidar3d import beams, casting
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.lidar3d.space import into_tunnel, turned
from subterra_jax.parts import Drive, Moved, Noise, Odometer, PlanarLidar, Sight, SpatialLidar, Step, Unicycle
from subterra_jax.parts.odometer import OdometryState
from subterra_jax.parts.part import Batch, Keys
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel, foot, node_at

PERIODS = 10  # control periods of the gait in one of the task
_BEYOND = 0.5  # m outside a mouth at which the trunk's middle has left the tunnel


@struct.dataclass
class StepSums:
    """Sums over the control periods of one step.

    Attributes:
        distance: Distance by leg odometry, m.
        turn: Turn by the gyroscope, rad.
        clearance: Least distance to a wall, m.
        contact: 1 where a wall was touched, else 0.
        fall: 1 where the robot fell, else 0.
    """

    distance: Float[Array, ""]
    turn: Float[Array, ""]
    clearance: Float[Array, ""]
    contact: Float[Array, ""]
    fall: Float[Array, ""]


@struct.dataclass
class LegsState:
    """A robot on its legs.

    Attributes:
        walk: State of the walking robot.
        sums: Sums over the last step.
    """

    walk: WalkState
    sums: StepSums


@dataclasses.dataclass(frozen=True)
class Legs(Unicycle):
    """A Unitree B2 on a frozen gait.

    `info` also has `fall`, and the `height` of the trunk over the sleepers (m). `clearance` is the least of the step,
    from the nearer of the two discs that make up the robot's envelope.

    Attributes:
        walk: The walking robot, driven from outside.
    """

    walk: WalkEnv = dataclasses.field(default_factory=lambda: WalkEnv(driven=True))
    name: ClassVar[str] = "legs"
    on_the_plan: ClassVar[bool] = False
    streams: ClassVar[tuple[int, ...]] = (2,)

    def defaults(self) -> dict[str, Any]:
        """Return `vehicle`, the limits of a command; `walk`, the robot; and `policy`, its gait (None: the trot)."""
        return {**super().defaults(), "walk": None, "policy": None}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> WalkResetNoise:
        """Draw how the robot is built, and its first readings."""
        return draws.draw_reset(key, batch)

    def draw_step(self, key: PRNGKeyArray, batch: Batch, params: EnvParams) -> WalkStepNoise:
        return draws.draw_step(key, (*batch, PERIODS))

    def begin(self, draw: WalkResetNoise, state: State, params: EnvParams) -> LegsState:
        zero = jnp.zeros(())
        return LegsState(stand(state, draw, params.walk), StepSums(zero, zero, zero, zero, zero))

    def move(self, state: State, drive: Drive, noise: WalkStepNoise, tunnel: Tunnel, params: EnvParams) -> Moved:
        """Walk for one control period of the task; see `Motion.move`."""
        walk, sums, height = self._walk(state.legs.walk, drive.wheels, noise, params)
        position, heading = pose_on_plan(walk, params.walk)
        motion = _mean_motion(state, position, heading, params)
        fall = sums.fall > 0.0
        outside = _outside(foot(tunnel, position, state.station).station, tunnel)
        return Moved(
            position=position,
            heading=heading,
            drive=Drive(motion, motion),
            own=LegsState(walk, sums),
            clearance=sums.clearance,
            contact=(sums.contact > 0.0) | outside,
            fallen=fall,
            info={"height": height, "fall": fall},
        )

    def _walk(
        self, walk: WalkState, command: Float[Array, "2"], noise: WalkStepNoise, params: EnvParams
    ) -> tuple[WalkState, StepSums, Float[Array, ""]]:
        """The robot at the end of a step, the sums over it, and the height of its trunk, m."""
        walk = dataclasses.replace(walk, command=jnp.stack([command[0], jnp.zeros(()), command[1]]))
        period = self.walk.physics.period

        def control(walk: WalkState, drawn: WalkStepNoise) -> tuple[WalkState, tuple[StepSums, Array]]:
            action = jnp.zeros(12)
            if params.policy is not None:
                action = params.policy.act(self.walk.observe(walk, drawn, params.walk))
            walk, _, fall, _, info = self.walk.advance(walk, action, drawn, params.walk)
            sensors = walk.proprioception
            # About the vertical, whichever way the trunk leans.
            turning = -jnp.sum(sensors.rates * sensors.gravity)
            contact, fell = (flag.astype(jnp.float32) for flag in (info["contact"], fall))
            sums = StepSums(sensors.velocity[0] * period, turning * period, info["clearance"], contact, fell)
            return walk, (sums, info["height"])

        walk, (periods, height) = lax.scan(control, walk, noise)
        sums = StepSums(
            distance=jnp.sum(periods.distance),
            turn=jnp.sum(periods.turn),
            clearance=jnp.min(periods.clearance),
            contact=jnp.max(periods.contact),
            fall=jnp.max(periods.fall),
        )
        return walk, sums, height[-1]


@dataclasses.dataclass(frozen=True)
class LegOdometer(Odometer):
    """Distance by the standing legs and heading by the gyroscope, with the bias of the heading that the task states."""

    def advance(self, own: OdometryState, step: Step, noise: Noise, params: EnvParams) -> OdometryState:
        sums = step.after[Legs.name].sums
        turned = sums.turn + own.heading_bias * jnp.asarray(params.vehicle.period)
        return dataclasses.replace(own, distance=own.distance + sums.distance, heading=wrap(own.heading + turned))


@dataclasses.dataclass(frozen=True)
class TrunkLidar(PlanarLidar):
    """The planar LiDAR where the trunk has it, tilted as the trunk is."""

    def defaults(self) -> dict[str, Any]:
        """Return `lidar`, and `relief`: the surface that it sees; None for the planar tunnel with upright walls."""
        return {**super().defaults(), "relief": None}

    def true_ranges(self, own: Any, sight: Sight, params: EnvParams) -> Array:
        """Cast the beams from the trunk, m."""
        walk = sight.parts[Legs.name].walk
        return scan(walk, sight.station, params.walk, params.lidar, params.relief)

    def skips_unwanted(self, params: EnvParams) -> bool:
        """Tell that every scan is cast."""
        return False


@dataclasses.dataclass(frozen=True)
class TrunkSpatialLidar(SpatialLidar):
    """The LiDAR in three dimensions where the trunk has it, tilted as the trunk is.

    Lateral place and turns of its mount count from there; the mount's height does not.
    """

    def defaults(self) -> dict[str, Any]:
        """Return `lidar`, and `relief`: the surface that it sees; None for that of the tunnel, without sleepers."""
        return {**super().defaults(), "relief": None}

    def poses(self, own: Any, sight: Sight, params: EnvParams) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """Return origin (m) and direction of each beam, tunnel frame."""
        sensor, walk = params.lidar, sight.parts[Legs.name].walk
        quaternion, unit = walk.body.qpos[3:7], jnp.eye(3)
        ahead, left, up = (tuple(rotate(quaternion, unit[i])) for i in range(3))
        _, place = lidar_place(walk, params.walk, sensor.mount.lateral)
        directions = into_tunnel(turned((ahead, left, up), sensor.mount), sensor.directions)
        return jnp.broadcast_to(place, (sensor.n_beams, 3)), directions

    def relief(self, sight: Sight, params: EnvParams) -> Relief:
        return sight.tunnel.space.relief if params.relief is None else params.relief


def _mean_motion(
    state: State, position: Float[Array, "2"], heading: Float[Array, ""], params: EnvParams
) -> Float[Array, "2"]:
    """Mean speed of the trunk along its mean heading (m/s) and its yaw rate (rad/s) in a step."""
    turned = wrap(heading - state.heading)
    middle = state.heading + 0.5 * turned
    x, y = position - state.position
    ahead = x * jnp.cos(middle) + y * jnp.sin(middle)
    return jnp.stack([ahead, turned]) / params.vehicle.period


def _outside(station: Float[Array, ""], tunnel: Tunnel) -> Bool[Array, ""]:
    return (station < -_BEYOND) | (station > tunnel.length + _BEYOND)


def stand(plane: State, noise: WalkResetNoise, walk: WalkParams) -> WalkState:
    """Make a robot that stands where a planar state says, on the sleepers, with no command.

    Args:
        plane: Position, heading, station and lateral offset.
        noise: Random numbers for its build, the clock of its gait and its first readings.
        walk: The robot and its track.
    """
    track = walk.track
    anchor = jnp.argmin(jnp.abs(track.station - plane.station)).astype(jnp.int32)
    along_track = track.quaternion[anchor]
    ahead = plane.station - track.station[anchor]
    position = rotate(along_track, jnp.stack([ahead, plane.lateral, jnp.float32(b2.STAND_HEIGHT)]))
    facing = compose(along_track, yaw_quaternion(wrap(plane.heading - yaw(along_track))))
    pose, _ = standing_pose()
    body = Body(jnp.concatenate([position, facing, pose]), jnp.zeros(18), jnp.zeros(18))
    drawn = draws.begin(noise, walk)
    return dataclasses.replace(
        drawn,
        body=body,
        anchor=anchor,
        command=jnp.zeros(3),
        drawn_command=jnp.zeros(3),
        facing=jnp.ones(()),
        proprioception=observation.measure(body, noise.sensor, jnp.zeros(2), drawn.gait, walk.sensor, walk.gait),
        furthest=plane.station,
    )


def pose_on_plan(walk: WalkState, params: WalkParams) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Return the position of the trunk's middle (tunnel frame, m) and its heading (rad), seen from above."""
    position = params.track.position[walk.anchor, :2] + walk.body.qpos[:2]
    return position, yaw(walk.body.qpos[3:7])


def yaw(quaternion: Float[Array, "4"]) -> Float[Array, ""]:
    """Return the direction of the turned x axis, seen from above, rad."""
    x, y, _ = rotate(quaternion, jnp.array([1.0, 0.0, 0.0]))
    return jnp.arctan2(y, x)


def lidar_place(
    walk: WalkState, params: WalkParams, lateral: Float[Array, ""] | float = 0.0
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return the place of the LiDAR, `lateral` m to the left of the trunk's middle: from the anchor, and in the tunnel.

    In the tunnel frame float32 rounds to a tenth of a millimetre a kilometre away; from the anchor it does not.
    """
    x, y, z = b2.LIDAR
    mount = walk.body.qpos[:3] + rotate(walk.body.qpos[3:7], jnp.stack([jnp.float32(x), y + lateral, jnp.float32(z)]))
    return mount, params.track.position[walk.anchor] + mount


def scan(
    walk: WalkState, station: Float[Array, ""], params: WalkParams, sensor: LidarParams, relief: Relief | None
) -> Float[Array, "n_beams"]:
    """Casts one planar scan from the trunk, tilted as the trunk is.

    With a relief, all of its triangles are seen. Without one, the walls of the planar tunnel stand upright and the
    ballast is a plane along the track, on which beams that point down end.

    Args:
        walk: The robot.
        station: Its station, m.
        params: The robot's track and tunnel.
        sensor: The LiDAR.
        relief: The bore's surface, if there is one.

    Returns:
        True ranges, m, in [0, range_max]; exactly `range_max` where a beam meets nothing within it.
    """
    quaternion = walk.body.qpos[3:7]
    mount, origin = lidar_place(walk, params)
    directions = jnp.asarray(beams.planar(sensor.n_beams), jnp.float32)
    if relief is not None:
        return casting.scan(relief, origin, quaternion, station, directions, sensor.range_max)
    directions = casting.rotate(quaternion, directions)
    up = rotate(params.track.quaternion[walk.anchor], jnp.array([0.0, 0.0, 1.0]))
    height = jnp.sum(mount * up) + params.track.protrusion
    nearest = jnp.minimum(_walls(origin, directions, station, params), _ground(height, up, directions))
    return jnp.minimum(nearest, sensor.range_max)


def _walls(
    origin: Float[Array, "3"], directions: Float[Array, "n_beams 3"], station: Float[Array, ""], params: WalkParams
) -> Float[Array, "n_beams"]:
    """Distance to upright walls, m; `inf` where there are none within the tunnel's reach."""
    level = jnp.sqrt(directions[:, 0] ** 2 + directions[:, 1] ** 2)
    # A beam straight up meets no wall; the division must not make it NaN.
    level = jnp.maximum(level, 1e-3)
    first = params.tunnel.scan_first[node_at(params.tunnel, station)]
    return cast.nearest(params.tunnel, first, origin[:2], directions[:, :2] / level[:, None]) / level


def _ground(
    height: Float[Array, ""], up: Float[Array, "3"], directions: Float[Array, "n_beams 3"]
) -> Float[Array, "n_beams"]:
    """Distance to the ballast, m; `inf` for beams that do not point down to it."""
    sinking = -(directions[:, 0] * up[0] + directions[:, 1] * up[1] + directions[:, 2] * up[2])
    return jnp.where(sinking > 1e-6, height / jnp.maximum(sinking, 1e-6), jnp.inf)
