"""The third dimension of a tunnel on the device: its surface, its ground, and where a sensor stands on it."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax import constants
from subterra_jax.host.errors import TunnelError
from subterra_jax.lidar3d.relief import Relief, stack_reliefs
from subterra_jax.tunnel import at_station
from subterra_jax.tunnel.plan import TunnelPlan

Rows = tuple[Array, Array, Array]


@struct.dataclass
class Space:
    """Surface and ground of a tunnel or of a stack of tunnels, beside the planar `Tunnel`."""

    relief: Relief  # the surface
    # height of the ground (m) and its rise along the axis (m/m) at each node of the tunnel's `grid`
    ground: Float[Array, "all_nodes 2"]

    @classmethod
    def from_plan(cls, plan: TunnelPlan, lining: str | None = None) -> "Space":
        """Put the bore of a plan on the device; takes some seconds per kilometre.

        Args:
            lining: Variant of its walls; `None` is `pockets`, or the first if there is none of that name.

        Raises:
            TunnelError: The plan comes from a file that holds no heights, or does not have the lining.
        """
        if plan.shell is None and plan.source:
            raise TunnelError(
                f"{plan.source}: holds no heights, which a LiDAR in three dimensions needs; build the scene again with "
                "`python -m scene.build`"
            )
        rise = np.gradient(plan.elevation, plan.station)
        ground = np.column_stack([plan.elevation, rise]).astype(np.float32)
        return cls(Relief.from_plan(plan, lining), jax.device_put(ground))

    def pick(self, index: Any) -> "Space":
        """Return the view of one tunnel of a stack."""
        return Space(self.relief.pick(index), self.ground)

    @staticmethod
    def join(spaces: Sequence[Any]) -> "Space | None":
        """Join those of several tunnels, in order; `None` where one of them has none."""
        if any(space is None for space in spaces):
            return None
        ground = np.concatenate([np.asarray(space.ground) for space in spaces])
        return Space(stack_reliefs([space.relief for space in spaces]), jax.device_put(ground))


@struct.dataclass
class Mount:
    """Place and attitude of a sensor on the robot.

    Attributes:
        height: Height above the ground, square to it, m.
        lateral: Distance to the left of the robot's middle, m.
        roll: Turn about the axis ahead, rad; positive lowers the right side.
        pitch: Turn about the axis to the left, rad; positive looks down.
        yaw: Turn about the upward axis, rad; positive looks to the left.
    """

    height: Float[Array, ""] | float = constants.SPATIAL_HEIGHT
    lateral: Float[Array, ""] | float = 0.0
    roll: Float[Array, ""] | float = 0.0
    pitch: Float[Array, ""] | float = 0.0
    yaw: Float[Array, ""] | float = 0.0


def ground_at(tunnel: Any, station: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return height (m) and rise along the axis (m/m) of the ground at a station; 0 in a tunnel without `Space`."""
    if tunnel.space is None:
        return jnp.zeros_like(station), jnp.zeros_like(station)
    place = station / tunnel.spacing
    node = jnp.clip(jnp.floor(place), 0, (tunnel.n_nodes - 2).astype(place.dtype))
    row, fraction = tunnel.first_node + node.astype(jnp.int32), place - node
    low, high = tunnel.space.ground[row], tunnel.space.ground[row + 1]
    return low[0] + fraction * (high[0] - low[0]), low[1] + fraction * (high[1] - low[1])


def level_axes(rise: Array, tangent_x: Array, tangent_y: Array, heading: Array) -> tuple[Rows, Rows, Rows]:
    """Return the axes ahead, left and up of a robot on ground that rises along the axis (m/m) and is level across it.

    The tangent of the axis in plan need be no unit vector; the heading is in plan too, rad.
    """
    level = 1.0 / jnp.sqrt(tangent_x**2 + tangent_y**2)
    slope_x, slope_y = rise * tangent_x * level, rise * tangent_y * level
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    up = _unit((-slope_x, -slope_y, jnp.ones_like(rise)))
    ahead = _unit((cos, sin, slope_x * cos + slope_y * sin))
    return ahead, _cross(up, ahead), up


def stand(
    tunnel: Any, position: Float[Array, "2"], heading: Float[Array, ""], station: Float[Array, ""], mount: Mount
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Return place and attitude of a sensor on a robot that stands on the ground, which is level across the track.

    Args:
        tunnel: The tunnel, with its `Space`.
        position: Position of the robot's middle in plan, tunnel frame, m.
        heading: Its heading in plan, rad.
        station: Its station, m.
        mount: The sensor on the robot.

    Returns:
        Position, tunnel frame, m; and the sensor's axes ahead, left and up as rows.
    """
    z, rise = ground_at(tunnel, station)
    _, _, tangent_x, tangent_y, _ = at_station(tunnel, station)
    ahead, left, up = level_axes(rise, tangent_x, tangent_y, heading)
    at = [
        p + mount.lateral * a + mount.height * b
        for p, a, b in zip((position[0], position[1], z), left, up, strict=True)
    ]
    return jnp.stack(at), turned((ahead, left, up), mount)


def turned(axes: tuple[Rows, Rows, Rows], mount: Mount) -> Float[Array, "3 3"]:
    """Return a sensor's axes ahead, left and up, as rows: the robot's, turned by yaw, then pitch, then roll."""
    ahead, left, up = axes
    ahead, left = _spin(ahead, left, mount.yaw)
    up, ahead = _spin(up, ahead, mount.pitch)
    left, up = _spin(left, up, mount.roll)
    return jnp.stack([jnp.stack(axis) for axis in (ahead, left, up)])


def _spin(first: Rows, second: Rows, angle: Any) -> tuple[Rows, Rows]:
    """Turn two axes of a right-handed frame about the third."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    (ax, ay, az), (bx, by, bz) = first, second
    return (
        (cos * ax + sin * bx, cos * ay + sin * by, cos * az + sin * bz),
        (cos * bx - sin * ax, cos * by - sin * ay, cos * bz - sin * az),
    )


def _unit(vector: Rows) -> Rows:
    size = jnp.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    return vector[0] / size, vector[1] / size, vector[2] / size


def _cross(a: Rows, b: Rows) -> Rows:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def into_tunnel(axes: Float[Array, "3 3"], directions: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Turn directions of a sensor with the given axes into the tunnel frame; written out, a library may use TF32."""
    x, y, z = directions[:, 0, None], directions[:, 1, None], directions[:, 2, None]
    return x * axes[None, 0] + y * axes[None, 1] + z * axes[None, 2]
