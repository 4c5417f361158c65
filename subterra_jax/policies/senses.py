"""What a network with memory is shown: beams that make a pocket stand out, and dead reckoning done for it.

Training and released policies share these functions; what they compute is part of what a policy is.
"""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

PERIOD = 0.1  # s, of control
HALF_WIDTH = 2.8  # m, about which side beams are shown
N_AIM = 5
# Command and odometry err independently; these are their inverse variances for slips of 2 % + 2 % and 2 % + 1 %.
_COMMAND_SHARE = 0.4


@struct.dataclass
class Reckoning:
    """Dead reckoning from the start of an episode.

    Attributes:
        commanded: Sum of the commanded distance, m.
        action: Last action, m/s and rad/s.
        begun: Steps since the episode began.
    """

    commanded: Float[Array, "*env"]
    action: Float[Array, "*env 2"]
    begun: Float[Array, "*env"]


def start(batch: tuple[int, ...]) -> Reckoning:
    """Nothing driven yet."""
    return Reckoning(jnp.zeros(batch), jnp.zeros((*batch, 2)), jnp.zeros(batch))


def advance(now: Reckoning, action: Float[Array, "*env 2"], done: Bool[Array, "*env"] | bool) -> Reckoning:
    """After an action; all anew where an episode ended with it."""
    keep = 1.0 - jnp.asarray(done, jnp.float32)
    commanded = now.commanded + PERIOD * jnp.maximum(action[..., 0], 0.0)
    return Reckoning(keep * commanded, keep[..., None] * action, keep * (now.begun + 1.0))


def fused(now: Reckoning, distance: Float[Array, "*env"]) -> Float[Array, "*env"]:
    """Distance driven as command and odometry together have it, m."""
    return _COMMAND_SHARE * now.commanded + (1.0 - _COMMAND_SHARE) * distance


def features(
    ranges: Float[Array, "*env n_beams"],
    odometry: Float[Array, "*env 2"],
    goal: Float[Array, "*env"],
    pitch: Float[Array, "*env"],
    now: Reckoning,
) -> Float[Array, "*env n"]:
    """Inputs of the network, all of order 1.

    Args:
        ranges: Ranges, m.
        odometry: Dead-reckoned distance (m) and heading (rad).
        goal: Chainage of the goal less that of the start, m.
        pitch: Distance between rings, m; 0 where there are none.
        now: Dead reckoning so far.
    """
    n_beams = ranges.shape[-1]
    side = np.abs(np.sin(np.arange(n_beams) * (2.0 * np.pi / n_beams))).astype(np.float32)
    # A pocket of 13 cm is nothing in 30 m; across the tunnel it is a third of the scale.
    across = jnp.clip((ranges * side - HALF_WIDTH) / 0.3, -3.0, 3.0)
    reckoned = fused(now, odometry[..., 0])
    ahead, turn = goal - reckoned, 2.0 * jnp.pi / jnp.maximum(pitch, 0.5)
    single = [
        jnp.sin(turn * odometry[..., 0]),
        jnp.cos(turn * odometry[..., 0]),
        jnp.sin(turn * now.commanded),
        jnp.cos(turn * now.commanded),
        (odometry[..., 0] - now.commanded) / 3.0,
        odometry[..., 1],
        reckoned / 100.0,
        jnp.tanh(ahead / 3.0),
        jnp.tanh(ahead / 30.0),
        (pitch - 1.35) / 0.15,
        jnp.minimum(now.begun, 10.0) / 10.0,
    ]
    return jnp.concatenate([across, ranges / 30.0, now.action, jnp.stack(single, axis=-1)], axis=-1)


def aim(ahead: Float[Array, "*env"], log_sigma: Float[Array, "*env"]) -> Float[Array, "*env 5"]:
    """The way to go at several scales, from the last decimetres on.

    Args:
        ahead: Goal less estimated station, m.
        log_sigma: Log of the standard deviation of the estimate, m.
    """
    scaled = [jnp.tanh(ahead / scale) for scale in (0.5, 2.0, 10.0)]
    return jnp.stack([*scaled, jnp.clip(ahead / 100.0, -1.0, 4.0), log_sigma], axis=-1)


def centres(bins: int, width: float) -> Float[np.ndarray, "bins"]:
    """Middles of the bins of the estimation head, m of true less reckoned distance."""
    return ((np.arange(bins) - 0.5 * (bins - 1)) * width).astype(np.float32)
