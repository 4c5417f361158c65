"""What a network with memory is shown: beams that make a pocket stand out, rings counted, dead reckoning done.

Training and released policies share these functions; what they compute is part of what a policy is, and `VERSION` and
`Senses` say which they are.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.avoidance import Surroundings
from subterra_jax.policies import boxes
from subterra_jax.policies.trackers import tracker

VERSION = 2
PERIOD = 0.1  # s, of control
HALF_WIDTH = 2.8  # m, about which side beams are shown
N_AIM = 5
_N_FURTHER = 18  # features that are no beams; each beam is seen twice
# rad; who has turned by so much since the flag was raised faces the start.
_TURNED = 2.2
Parts = Mapping[str, Float[Array, "*env n"]]


@dataclasses.dataclass(frozen=True)
class Senses:
    """What a network is shown beside beams and dead reckoning; the policies of before there was a choice have neither.

    Attributes:
        tracker: Who counts rings, a name of `trackers.TRACKERS`.
        boxes: Whether the boxes remembered, and the lane to take between them, are shown.
    """

    tracker: str = "loop"
    boxes: bool = False

    @property
    def n_further(self) -> int:
        """Features that are no beams."""
        return _N_FURTHER + (boxes.N_FEATURES if self.boxes else 0)

    def n_beams(self, n_features: int) -> int:
        """Beams that so many features show."""
        return (n_features - self.n_further) // 2


PLAIN = Senses()


@struct.dataclass
class Reckoning:
    """Dead reckoning from the start of an episode, and the rings counted on the way.

    Attributes:
        rings: What the tracker knows.
        commanded: Sum of the commanded distance, m.
        step: Distance commanded since the last look, m.
        reading: Odometer at the last look, m.
        action: Last action, m/s and rad/s.
        begun: Steps since the episode began.
        flag: 1 once the flag of a task with a way back was seen, else 0.
        flagged_at: Heading then, rad.
        back: 1 from the turn on, else 0.
        boxes: What is remembered of boxes, where that is shown.
        senses: What is shown.
    """

    rings: Any
    commanded: Float[Array, "*env"]
    step: Float[Array, "*env"]
    reading: Float[Array, "*env"]
    action: Float[Array, "*env 2"]
    begun: Float[Array, "*env"]
    flag: Float[Array, "*env"]
    flagged_at: Float[Array, "*env"]
    back: Float[Array, "*env"]
    boxes: Surroundings | None = None
    senses: Senses = struct.field(pytree_node=False, default=PLAIN)


@struct.dataclass
class Sight:
    """A look at an observation.

    Attributes:
        features: Inputs of the network, all of order 1.
        station: Station less that of the start by rings and dead reckoning, m.
        ahead: Where to go, less `station`, m: to the goal, once the flag is raised to the start.
        reckoning: With this look; for `advance`.
    """

    features: Float[Array, "*env n"]
    station: Float[Array, "*env"]
    ahead: Float[Array, "*env"]
    reckoning: Reckoning


def start(batch: tuple[int, ...], n_beams: int, shown: Senses = PLAIN) -> Reckoning:
    """Nothing driven yet.

    Args:
        batch: Leading axes.
        n_beams: Beams of a scan.
        shown: What the network is shown.

    Raises:
        ValueError: There is no such tracker.
    """
    zero = jnp.zeros(batch)
    return Reckoning(
        rings=tracker(shown.tracker).start(batch, n_beams),
        commanded=zero,
        step=zero,
        reading=zero,
        action=jnp.zeros((*batch, 2)),
        begun=zero,
        flag=zero,
        flagged_at=zero,
        back=zero,
        boxes=boxes.start(batch, n_beams) if shown.boxes else None,
        senses=shown,
    )


def look(part: Parts, begin: Float[Array, ""] | float, now: Reckoning) -> Sight:
    """Takes an observation in; every observation is to be looked at once.

    Args:
        part: `ranges` (m), `odometry` (distance, m, and heading, rad), `goal` (chainage, m), `ring_pitch` (m; 0 where
            there are no rings) and, in a task with a way back, `flag`, each with a last axis.
        begin: Believed chainage of the start, m.
        now: Reckoning so far.
    """
    reading, heading = part["odometry"][..., 0], part["odometry"][..., 1]
    goal, pitch = part["goal"][..., 0] - begin, part["ring_pitch"][..., 0]
    flag = part["flag"][..., 0] if "flag" in part else jnp.zeros_like(reading)
    flagged_at = jnp.where((flag > 0.5) & (now.flag < 0.5), heading, now.flagged_at)
    turned = jnp.abs(jnp.mod(heading - flagged_at + jnp.pi, 2.0 * jnp.pi) - jnp.pi)
    back = jnp.where((flag > 0.5) & (turned > _TURNED), 1.0, now.back)
    counted = tracker(now.senses.tracker)
    moved, near = counted.moved(now.step, reading - now.reading), now.boxes
    if near is not None:
        near = boxes.look(near, part["ranges"], now.action, now.begun < 0.5, back > now.back)
        moved = moved * boxes.cosine(near)
    track = counted.advance(now.rings, part["ranges"], moved, 1.0 - 2.0 * back, pitch)
    seen = now.replace(rings=track, reading=reading, flag=flag, flagged_at=flagged_at, back=back, boxes=near)  # type: ignore[attr-defined]
    ahead = jnp.where(flag > 0.5, 0.0, goal) - track.station
    return Sight(_features(part["ranges"], heading, ahead, pitch, seen), track.station, ahead, seen)


def advance(now: Reckoning, action: Float[Array, "*env 2"], done: Bool[Array, "*env"] | bool) -> Reckoning:
    """After an action; all anew where an episode ended with it."""
    keep = 1.0 - jnp.broadcast_to(jnp.asarray(done, jnp.float32), now.begun.shape)
    step = PERIOD * jnp.maximum(action[..., 0], 0.0)
    return Reckoning(
        rings=tracker(now.senses.tracker).anew(now.rings, keep),
        commanded=keep * (now.commanded + step),
        step=keep * step,
        reading=keep * now.reading,
        action=keep[..., None] * action,
        begun=keep * (now.begun + 1.0),
        flag=keep * now.flag,
        flagged_at=keep * now.flagged_at,
        back=keep * now.back,
        boxes=now.boxes,  # the first look of an episode replaces it
        senses=now.senses,
    )


def instead(before: Reckoning, after: Reckoning, action: Float[Array, "*env 2"]) -> Reckoning:
    """The reckoning after an action of which somebody else made another; `before` is that before the look at it."""
    step = PERIOD * jnp.maximum(action[..., 0], 0.0)
    return after.replace(commanded=before.commanded + step, step=step, action=action)  # type: ignore[attr-defined]


def _features(
    ranges: Float[Array, "*env n_beams"],
    heading: Float[Array, "*env"],
    ahead: Float[Array, "*env"],
    pitch: Float[Array, "*env"],
    seen: Reckoning,
) -> Float[Array, "*env n"]:
    n_beams = ranges.shape[-1]
    side = np.abs(np.sin(np.arange(n_beams) * (2.0 * np.pi / n_beams))).astype(np.float32)
    # A pocket of 13 cm is nothing in 30 m; across the tunnel it is a third of the scale.
    across = jnp.clip((ranges * side - HALF_WIDTH) / 0.3, -3.0, 3.0)
    track, turn = seen.rings, 2.0 * jnp.pi / jnp.maximum(pitch, 0.5)
    single: list[Any] = [
        jnp.sin(turn * track.station),
        jnp.cos(turn * track.station),
        jnp.clip(5.0 * track.innovation, -2.0, 2.0),
        track.strength,
        20.0 * track.rate,
        (track.station - track.reckoned) / 3.0,
        (seen.reading - seen.commanded) / 3.0,
        jnp.sin(heading),
        jnp.cos(heading),
        track.station / 100.0,
        jnp.tanh(ahead / 3.0),
        jnp.tanh(ahead / 30.0),
        (pitch - 1.35) / 0.15,
        jnp.minimum(seen.begun, 10.0) / 10.0,
        seen.flag,
        seen.back,
    ]
    near = [] if seen.boxes is None else [boxes.features(seen.boxes)]
    return jnp.concatenate([across, ranges / 30.0, seen.action, jnp.stack(single, axis=-1), *near], axis=-1)


def aim(ahead: Float[Array, "*env"], log_sigma: Float[Array, "*env"]) -> Float[Array, "*env 5"]:
    """The way to go at several scales, from the last decimetres on.

    Args:
        ahead: Goal less estimated station, m.
        log_sigma: Log of the standard deviation of the estimate, m.
    """
    scaled = [jnp.tanh(ahead / scale) for scale in (0.5, 2.0, 10.0)]
    return jnp.stack([*scaled, jnp.clip(ahead / 100.0, -1.0, 4.0), log_sigma], axis=-1)


def centres(bins: int, width: float) -> Float[np.ndarray, "bins"]:
    """Middles of the bins of the estimation head, m of true less tracked distance."""
    return ((np.arange(bins) - 0.5 * (bins - 1)) * width).astype(np.float32)
