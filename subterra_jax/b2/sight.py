"""What the robot's LiDAR sees from where the trunk really has it, tilt and all."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from subterra_jax.b2 import constants as b2
from subterra_jax.b2.kinematics import rotate
from subterra_jax.b2.params import WalkParams, WalkState
from subterra_jax.lidar import LidarParams, cast
from subterra_jax.lidar3d import beams, casting
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.tunnel import node_at


def scan(
    walk: WalkState, station: Float[Array, ""], params: WalkParams, sensor: LidarParams, relief: Relief | None
) -> Float[Array, "n_beams"]:
    """True ranges of one planar scan that tilts with the trunk.

    Against a relief every triangle counts. Without one the planar tunnel is all there is: its walls are taken to stand
    upright and the ballast to be a plane along the track, so that a beam which points down ends on the ground.

    Args:
        walk: The robot.
        station: Its station, m.
        params: The robot's track and tunnel.
        sensor: The LiDAR.
        relief: The bore's surface, if there is one.

    Returns:
        Ranges, m, in [0, range_max]; exactly `range_max` where a beam meets nothing within it.
    """
    quaternion = walk.body.qpos[3:7]
    # From the anchor: in the tunnel frame float32 would round to a tenth of a millimetre a kilometre away.
    mount = walk.body.qpos[:3] + rotate(quaternion, jnp.array(b2.LIDAR))
    origin = params.track.position[walk.anchor] + mount
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
    # A beam straight up meets no wall; dividing by what is left of its level part must not make it NaN.
    level = jnp.maximum(level, 1e-3)
    first = params.tunnel.scan_first[node_at(params.tunnel, station)]
    return cast.nearest(params.tunnel, first, origin[:2], directions[:, :2] / level[:, None]) / level


def _ground(
    height: Float[Array, ""], up: Float[Array, "3"], directions: Float[Array, "n_beams 3"]
) -> Float[Array, "n_beams"]:
    """Distance to the ballast, m; `inf` for beams that do not point down to it."""
    sinking = -(directions[:, 0] * up[0] + directions[:, 1] * up[1] + directions[:, 2] * up[2])
    return jnp.where(sinking > 1e-6, height / jnp.maximum(sinking, 1e-6), jnp.inf)
