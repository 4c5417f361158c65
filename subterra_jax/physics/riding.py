"""Tasks by physics: what motions on an engine have in common, and LiDARs that sway with the robot."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax import lidar3d
from subterra_jax.lidar import LidarParams, nearest
from subterra_jax.lidar3d import beams
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.lidar3d.space import into_tunnel, turned
from subterra_jax.parts import Drive, Moved, Part, PlanarLidar, SensingState, SpatialLidar, Unicycle
from subterra_jax.parts.unicycle import wrap
from subterra_jax.physics.engine import Body, Build, Engine
from subterra_jax.physics.ground import Track, look_around, move_anchor
from subterra_jax.physics.rotations import compose, inverse, rotate, yaw, yaw_quaternion
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel, foot, node_at

_BEYOND = 0.5  # m outside a mouth at which the trunk's middle has left the tunnel
_TILT = 1.0  # of a trunk that has fallen, rad


@struct.dataclass
class Ride:
    """A robot on the ground."""

    body: Body  # state of the physics, positions from the anchor
    anchor: Int[Array, ""]  # row of the track nearest to it


def place_on(track: Track, plane: State, height: float) -> tuple[Float[Array, "7"], Int[Array, ""]]:
    """Return position from the anchor (m) and rotation of a trunk over the ground, and the anchor.

    Args:
        plane: Station, lateral offset, heading and number of the tunnel.
        height: Height of the trunk's middle over the sleepers' tops, m.
    """
    anchor = track.nearest(plane.station, plane.tunnel)
    turn = track.quaternion[anchor]
    position = rotate(turn, jnp.stack([plane.station - track.station[anchor], plane.lateral, jnp.float32(height)]))
    facing = compose(turn, yaw_quaternion(wrap(plane.heading - yaw(turn))))
    return jnp.concatenate([position, facing]), anchor


def advance_period(
    engine: Engine,
    ride: Ride,
    control: Float[Array, "n_servos"],
    build: Build | None,
    track: Track,
    tunnel: Tunnel,
) -> tuple[Ride, Float[Array, ""], Float[Array, ""], Bool[Array, ""]]:
    """Advance a robot by one control period of its engine.

    Returns:
        The robot, its station before (m), the least distance of a bumper's middle to a wall before (m), and whether
        physics went wrong: the robot then stays as it was.
    """
    window, station = look_around(track, tunnel, ride.anchor, ride.body.qpos, engine.bumpers)
    body = engine.run(ride.body, control, window, build)
    finite = jnp.all(jnp.isfinite(body.qpos)) & jnp.all(jnp.isfinite(body.qvel))
    body = jax.tree.map(lambda new, old: jnp.where(finite, new, old), body, ride.body)
    anchor, position = move_anchor(track, ride.anchor, body.qpos[:3])
    body = dataclasses.replace(body, qpos=body.qpos.at[:3].set(position))
    return Ride(body, anchor), station, jnp.min(window.gap), ~finite


def has_tipped(body: Body, tilt: Any = _TILT) -> Bool[Array, ""]:
    """Tell whether the trunk leans by more than an angle, rad."""
    return rotate(inverse(body.qpos[3:7]), jnp.array([0.0, 0.0, 1.0]))[2] < jnp.cos(tilt)


@dataclasses.dataclass(frozen=True)
class Physical(Unicycle):
    """A motion by physics: its robot obeys commands as far as it can.

    `info` also has `fall`, and the `height` of the trunk over the anchor (m). `clearance` is the least of the step,
    from the middle of the nearest bumper.

    Attributes:
        lidar_place: Place of the LiDAR on the trunk, m.
    """

    lidar_place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    on_the_plan: ClassVar[bool] = False

    def defaults(self) -> dict[str, Any]:
        """Return `vehicle`, the limits of a command; `track`, the ground; and `relief`, the surface that a LiDAR sees.

        None is the planar tunnel with upright walls, or in three dimensions the tunnel's own surface.
        """
        return {**super().defaults(), "track": None, "relief": None}

    def in_tunnel(self, params: EnvParams, tunnel: Any) -> EnvParams:
        """Return params that hold one tunnel of a stack; that tunnel's ground is the first there."""
        params, track = super().in_tunnel(params, tunnel), params.track
        return params.replace(track=track.replace(tunnel=track.tunnel - tunnel))

    def carried(self, part: Part) -> Part:
        """Return a LiDAR as this robot carries it; other parts as they are."""
        if isinstance(part, SpatialLidar):
            return SwayingSpatialLidar(motion=self)
        return SwayingLidar(motion=self) if isinstance(part, PlanarLidar) else part

    def moved(
        self,
        state: State,
        own: Ride,
        wheels: Float[Array, "2"],
        clearance: Float[Array, ""],
        contact: Bool[Array, ""],
        fallen: Bool[Array, ""],
        tunnel: Tunnel,
        params: EnvParams,
    ) -> Moved:
        """Return the result of a step: see `Moved`; `wheels` is what the robot itself takes for its mean motion."""
        position, heading = params.track.position[own.anchor, :2] + own.body.qpos[:2], yaw(own.body.qpos[3:7])
        station = foot(tunnel, position, state.station).station
        outside = (station < -_BEYOND) | (station > tunnel.length + _BEYOND)
        return Moved(
            position=position,
            heading=heading,
            drive=Drive(wheels, mean_motion(state, position, heading, params)),
            own=own,
            clearance=clearance,
            contact=contact | outside,
            fallen=fallen,
            info={"height": own.body.qpos[2], "fall": fallen},
        )


def mean_motion(
    state: State, position: Float[Array, "2"], heading: Float[Array, ""], params: EnvParams
) -> Float[Array, "2"]:
    """Mean speed of the trunk along its mean heading (m/s) and its yaw rate (rad/s) in a step."""
    turned = wrap(heading - state.heading)
    middle = state.heading + 0.5 * turned
    x, y = position - state.position
    ahead = x * jnp.cos(middle) + y * jnp.sin(middle)
    return jnp.stack([ahead, turned]) / params.vehicle.period


def lidar_pose(
    ride: Ride,
    sensing: SensingState,
    track: Track,
    place: tuple[float, float, float],
    lateral: Float[Array, ""] | float = 0.0,
) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
    """Return the origin (tunnel frame, m) and the rotation of a LiDAR at the state that is shown.

    Args:
        ride: The robot, which gives height and lean.
        sensing: The state, which gives position and heading; faults show an earlier one.
        place: Where the LiDAR stands on the trunk, m.
        lateral: Distance to the left of there, m.
    """
    x, y, z = place
    turn = ride.body.qpos[3:7]
    turn = compose(yaw_quaternion(wrap(sensing.heading - yaw(turn))), turn)
    height = track.position[ride.anchor, 2] + ride.body.qpos[2]
    arm = rotate(turn, jnp.stack([jnp.float32(x), y + lateral, jnp.float32(z)]))
    return jnp.stack([*sensing.position, height]) + arm, turn


@dataclasses.dataclass(frozen=True)
class SwayingLidar(PlanarLidar):
    """The planar LiDAR on a robot with mass, tilted as its trunk is."""

    motion: Physical = dataclasses.field(default_factory=Physical)

    def true_ranges(self, own: Any, sensing: SensingState, params: EnvParams) -> Array:
        """Cast the beams from the trunk, m."""
        ride = sensing.parts[self.motion.name]
        origin, turn = lidar_pose(ride, sensing, params.track, self.motion.lidar_place)
        return scan(origin, turn, ride.anchor, sensing, params.track, params.lidar, params.relief)

    def skips_unneeded(self, params: EnvParams) -> bool:
        """Tell that every scan is cast."""
        return False


@dataclasses.dataclass(frozen=True)
class SwayingSpatialLidar(SpatialLidar):
    """The LiDAR in three dimensions on a robot with mass, tilted as its trunk is.

    Lateral place and turns of its mount count from there; the mount's height does not.
    """

    motion: Physical = dataclasses.field(default_factory=Physical)

    def poses(
        self, own: Any, sensing: SensingState, params: EnvParams
    ) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """Return origin (m) and direction of each beam, tunnel frame."""
        sensor, ride = params.lidar, sensing.parts[self.motion.name]
        place, turn = lidar_pose(ride, sensing, params.track, self.motion.lidar_place, sensor.mount.lateral)
        ahead, left, up = (tuple(rotate(turn, axis)) for axis in jnp.eye(3))
        directions = into_tunnel(turned((ahead, left, up), sensor.mount), sensor.directions)
        return jnp.broadcast_to(place, (sensor.n_beams, 3)), directions

    def relief(self, sensing: SensingState, params: EnvParams) -> Relief:
        return sensing.tunnel.space.relief if params.relief is None else params.relief


def scan(
    origin: Float[Array, "3"],
    turn: Float[Array, "4"],
    anchor: Int[Array, ""],
    sensing: SensingState,
    track: Track,
    sensor: LidarParams,
    relief: Relief | None,
) -> Float[Array, "n_beams"]:
    """Cast one planar scan, tilted as the trunk is.

    With a relief, all of its triangles are seen. Without one, the walls of the planar tunnel stand upright and the
    ballast is a plane along the track, on which beams that point down end.

    Args:
        origin: Place of the LiDAR, tunnel frame, m.
        anchor: Row of the track nearest to it.
        sensing: The state that is shown.
        relief: The bore's surface, if there is one.

    Returns:
        True ranges, m, in [0, range_max]; exactly `range_max` where a beam meets nothing within it.
    """
    directions = jax.vmap(rotate, (None, 0))(turn, jnp.asarray(beams.planar(sensor.n_beams), jnp.float32))
    if relief is not None:
        return lidar3d.meet(relief, origin, directions[None], sensing.station, sensor.range_max).ranges[0]
    up = rotate(track.quaternion[anchor], jnp.array([0.0, 0.0, 1.0]))
    height = jnp.sum((origin - track.position[anchor]) * up) + track.protrusion[anchor]
    nearest = jnp.minimum(_walls(origin, directions, sensing), _ground(height, up, directions))
    return jnp.minimum(nearest, sensor.range_max)


def _walls(
    origin: Float[Array, "3"], directions: Float[Array, "n_beams 3"], sensing: SensingState
) -> Float[Array, "n_beams"]:
    """Distance to upright walls, m; `inf` where there are none within the tunnel's reach."""
    level = jnp.sqrt(directions[:, 0] ** 2 + directions[:, 1] ** 2)
    # A beam straight up meets no wall; the division must not make it NaN.
    level = jnp.maximum(level, 1e-3)
    first = sensing.tunnel.scan_first[node_at(sensing.tunnel, sensing.station)]
    return nearest(sensing.tunnel, first, origin[:2], directions[:, :2] / level[:, None]) / level


def _ground(
    height: Float[Array, ""], up: Float[Array, "3"], directions: Float[Array, "n_beams 3"]
) -> Float[Array, "n_beams"]:
    """Distance to the ballast, m; `inf` for beams that do not point down to it."""
    sinking = -(directions[:, 0] * up[0] + directions[:, 1] * up[1] + directions[:, 2] * up[2])
    return jnp.where(sinking > 1e-6, height / jnp.maximum(sinking, 1e-6), jnp.inf)
