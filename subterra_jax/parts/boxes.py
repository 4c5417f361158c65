"""Boxes in the tunnel frame: ranges to them, and distances from them."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float


@struct.dataclass
class Boxes:
    """A few boxes in the tunnel frame."""

    centre: Float[Array, "n 2"]  # middles, m; far away where there is none
    axis: Float[Array, "n 2"]  # unit vectors along the first side
    half: Float[Array, "n 2"]  # half sides, m, the first along `axis`


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
