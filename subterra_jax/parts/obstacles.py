"""Obstacles, a part of an environment: where the boxes of an episode stand, ranges to them and distances from them."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, UInt32

from subterra_jax import constants
from subterra_jax.parts.part import Batch, Boxes, Keys, Part, SensingState, uniform_at
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel, at_station

PITCH = constants.BOX_PITCH  # m of tunnel for each box
REACH = 33.0  # m of arc on which anything within 30 m lies
N_SLOTS = 6  # cover twice the reach, wherever it begins
_N_NEAR = 2  # slots next to a point on either side of it, for contact


@struct.dataclass
class ObstacleParams:
    """Boxes, one in every 15 m of tunnel, and one parked trolley among them.

    Attributes:
        size_min: Least side of a box, m.
        size_max: Largest side of a box, m.
        gap: Free width left on one side of each box, m.
        first: No obstacle stands before this distance from the start, m.
        trolley_length: Length of the trolley, along the tunnel, m.
        trolley_width: Its width, m.
    """

    size_min: float = constants.BOX_SIZE_MIN
    size_max: float = constants.BOX_SIZE_MAX
    gap: float = constants.BOX_GAP
    first: float = constants.BOX_FIRST
    trolley_length: float = constants.TROLLEY_LENGTH
    trolley_width: float = constants.TROLLEY_WIDTH


def distance_along(
    boxes: Boxes, position: Float[Array, "2"], direction: Float[Array, "n_beams 2"]
) -> Float[Array, "n_beams"]:
    """Measure where each beam first meets a box, m; `inf` where it meets none, 0 from inside one."""
    p_x, p_y = _in_frame(boxes, position[None] - boxes.centre)
    axis_x, axis_y = boxes.axis[None, :, 0], boxes.axis[None, :, 1]
    d_x, d_y = direction[:, 0, None], direction[:, 1, None]
    ahead_x, ahead_y = d_x * axis_x + d_y * axis_y, d_y * axis_x - d_x * axis_y
    near_x, far_x = _slab(p_x, ahead_x, boxes.half[:, 0])
    near_y, far_y = _slab(p_y, ahead_y, boxes.half[:, 1])
    near, far = jnp.maximum(near_x, near_y), jnp.minimum(far_x, far_y)
    met = (near <= far) & (far >= 0.0)
    return jnp.min(jnp.where(met, jnp.maximum(near, 0.0), jnp.inf), axis=-1)


def distance_to(boxes: Boxes, position: Float[Array, "2"]) -> Float[Array, ""]:
    """Measure the distance from a point to the nearest box, m; 0 inside."""
    p_x, p_y = _in_frame(boxes, position[None] - boxes.centre)
    out_x, out_y = (jnp.maximum(jnp.abs(p) - boxes.half[:, i], 0.0) for i, p in enumerate((p_x, p_y)))
    apart = jnp.min(out_x * out_x + out_y * out_y)
    # The root has no derivative at 0, inside a box.
    outside = apart > 0.0
    return jnp.where(outside, jnp.sqrt(jnp.where(outside, apart, 1.0)), 0.0)


def _in_frame(boxes: Boxes, vector: Float[Array, "n 2"]) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    axis_x, axis_y = boxes.axis[:, 0], boxes.axis[:, 1]
    return vector[:, 0] * axis_x + vector[:, 1] * axis_y, vector[:, 1] * axis_x - vector[:, 0] * axis_y


def _slab(
    origin: Float[Array, "n"], ahead: Float[Array, "n_beams n"], half: Float[Array, "n"]
) -> tuple[Float[Array, "n_beams n"], Float[Array, "n_beams n"]]:
    """Return where beams enter and leave the strip |x| ≤ half."""
    tiny = jnp.where(ahead < 0.0, -1e-12, 1e-12)
    inverse = 1.0 / jnp.where(jnp.abs(ahead) < 1e-12, tiny, ahead)
    a, b = (-half - origin)[None] * inverse, (half - origin)[None] * inverse
    return jnp.minimum(a, b), jnp.maximum(a, b)


def boxes_in(seed: UInt32[Array, ""], slot: Int[Array, "n"], tunnel: Tunnel, params: ObstacleParams) -> Boxes:
    """Return the boxes of given slots; slot k has the stations from 15 k to 15 (k + 1) m.

    Equal seeds give equal boxes. `params.first` is a station here, m.
    """
    u = lambda index: uniform_at(seed, slot, index)  # noqa: E731
    n_slots = jnp.maximum(jnp.floor(tunnel.length / PITCH), 2.0)
    trolley = slot == 1 + jnp.floor(uniform_at(seed, jnp.zeros((), jnp.int32), 9) * (n_slots - 1.0)).astype(jnp.int32)
    side = 0.5 * (params.size_min + (params.size_max - params.size_min) * jnp.stack([u(0), u(1)], axis=-1))
    parked = 0.5 * jnp.stack([jnp.asarray(params.trolley_length), jnp.asarray(params.trolley_width)])
    half = jnp.where(trolley[:, None], parked[None], side)
    turn = jnp.where(trolley, 0.0, jnp.pi * u(2))
    # A margin of a trolley's half at both ends keeps the boxes of two slots apart.
    station = PITCH * slot.astype(jnp.float32) + 1.5 + (PITCH - 3.0) * u(3)
    x, y, tangent_x, tangent_y, half_width = jax.vmap(at_station, (None, 0), 1)(tunnel, station)
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    across = jnp.abs(sin) * half[:, 0] + jnp.abs(cos) * half[:, 1]
    lateral = jnp.maximum((half_width - across) * u(4), params.gap + across - half_width)
    lateral = jnp.where(u(5) < 0.5, -lateral, lateral)
    there = (station - half[:, 0] - half[:, 1] > params.first) & (station < tunnel.length)
    centre = jnp.stack([x - lateral * tangent_y, y + lateral * tangent_x], axis=-1)
    return Boxes(
        centre=jnp.where(there[:, None], centre, 1e6),
        axis=jnp.stack([tangent_x * cos - tangent_y * sin, tangent_x * sin + tangent_y * cos], axis=-1),
        half=half,
    )


@struct.dataclass
class ObstacleState:
    """Boxes of an episode."""

    seed: UInt32[Array, ""]  # seed of the boxes
    start: Float[Array, ""]  # station of the start, m


@dataclasses.dataclass(frozen=True)
class Obstacles(Part):
    """Boxes that stand in the way, ahead of a start that may lie anywhere."""

    name: ClassVar[str] = "obstacles"
    streams: ClassVar[tuple[int, ...]] = (6,)

    def defaults(self) -> dict[str, Any]:
        return {"obstacles": ObstacleParams()}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> UInt32[Array, "*batch 2"]:
        """Draw random bits, the first of two words: the second is that of the faults."""
        return jax.random.bits(key, (*batch, 2), jnp.uint32)

    def begin(self, draw: UInt32[Array, "2"], state: State, params: EnvParams) -> ObstacleState:
        return ObstacleState(draw[0], state.station)

    def clearance(
        self, own: ObstacleState, position: Array, station: Array, tunnel: Tunnel, params: EnvParams
    ) -> Array:
        return distance_to(_boxes_near(own, station, 3.0, _N_NEAR, tunnel, params), position)

    def hits(
        self, own: ObstacleState, sensing: SensingState, directions: Float[Array, "n_beams 2"], params: EnvParams
    ) -> Float[Array, "n_beams"]:
        boxes = _boxes_near(own, sensing.station, REACH, N_SLOTS, sensing.tunnel, params)
        return distance_along(boxes, sensing.position, directions)

    def boxes(self, own: ObstacleState, station: Array, tunnel: Tunnel, params: EnvParams) -> list[Boxes]:
        return [_boxes_near(own, station, REACH, N_SLOTS, tunnel, params)]


def _boxes_near(
    own: ObstacleState, station: Float[Array, ""], reach: float, n: int, tunnel: Tunnel, params: EnvParams
) -> Boxes:
    """Return the boxes of `n` slots, from `reach` before a station on, m; none before `first` from the start."""
    slot = jnp.floor((station - reach) / PITCH).astype(jnp.int32) + jnp.arange(n, dtype=jnp.int32)
    sizes: Any = params.obstacles
    return boxes_in(own.seed, slot, tunnel, sizes.replace(first=sizes.first + own.start))
