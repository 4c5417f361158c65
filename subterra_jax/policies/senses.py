"""Inputs of a network with memory: beams that make a pocket stand out, counted rings, and dead reckoning.

Training and released policies share these functions. What they compute is part of a policy, and `VERSION` and `Senses`
say which version and which choice a policy was trained with.
"""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.avoidance import Surroundings
from subterra_jax.baselines.reckoning import StepDistances
from subterra_jax.baselines.rings import grid as ringgrid
from subterra_jax.baselines.rings import loop as rings
from subterra_jax.policies import boxes

VERSION = 2
PERIOD = 0.1  # s, of control
HALF_WIDTH = 2.8  # m; beams to the side are shown relative to it
N_AIM = 5
_N_FURTHER = 18  # features that are no beams; each beam gives two features
# rad; a robot that has turned by so much since the flag was raised faces the start.
_TURNED = 2.2
Parts = Mapping[str, Float[Array, "*env n"]]


@dataclasses.dataclass(frozen=True)
class Tracker:
    """A counter of rings, as four functions with the arguments of those in `baselines.rings`.

    A track has at least the fields that the features below read.

    Attributes:
        start: Maps `(batch, n_beams)` to a track at the start.
        measure: Maps commanded and read distance of a step, m, to the distance driven.
        advance: Maps `(track, ranges, distance, direction, pitch)` to the track after a scan.
        restart: Maps `(track, keep)` to the track, at its start where `keep` is 0.
    """

    start: Callable[..., Any]
    measure: Callable[..., Any]
    advance: Callable[..., Any]
    restart: Callable[..., Any]


TRACKERS = {
    # The first released policies have this one.
    "loop": Tracker(rings.start, rings.fuse_distances, rings.advance, rings.restart),
    # Ignores what stands in the tunnel.
    "careful": Tracker(rings.start, rings.fuse_distances, partial(rings.advance, careful=True), rings.restart),
    # Holds on wet rail too.
    "grid": Tracker(ringgrid.start, StepDistances, ringgrid.advance, ringgrid.restart),
}


def tracker(name: str) -> Tracker:
    """Returns the tracker of a name.

    Raises:
        ValueError: There is no such tracker.
    """
    if name not in TRACKERS:
        raise ValueError(f"tracker must be one of {', '.join(TRACKERS)}, got {name!r}")
    return TRACKERS[name]


@dataclasses.dataclass(frozen=True)
class Senses:
    """Choice of the inputs beside beams and dead reckoning. The first released policies have the defaults.

    Attributes:
        tracker: Counter of rings, a name of `TRACKERS`.
        boxes: Show the boxes in memory, and the lane to take between them.
    """

    tracker: str = "loop"
    boxes: bool = False

    @property
    def n_further(self) -> int:
        """Number of features that are no beams."""
        return _N_FURTHER + (boxes.N_FEATURES if self.boxes else 0)

    def n_beams(self, n_features: int) -> int:
        """Returns the number of beams that so many features show."""
        return (n_features - self.n_further) // 2


PLAIN = Senses()


@struct.dataclass
class Reckoning:
    """Dead reckoning from the start of an episode, and the rings counted on the way.

    Attributes:
        rings: State of the tracker.
        commanded: Sum of the commanded distance, m.
        step: Distance commanded since the last look, m.
        reading: Odometer at the last look, m.
        action: Last action, m/s and rad/s.
        begun: Steps since the episode began.
        flag: 1 once the flag of a task with a way back was seen, else 0.
        flagged_at: Heading when the flag was raised, rad.
        back: 1 from the turn on, else 0.
        boxes: Memory of boxes; None where they are not shown.
        senses: Choice of the inputs.
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
    """Result of a look at an observation.

    Attributes:
        features: Inputs of the network, all of order 1.
        station: Station less that of the start, by rings and dead reckoning, m.
        ahead: Distance to the goal along the axis, or to the start once the flag is raised, m.
        reckoning: Reckoning with this look; for `advance`.
    """

    features: Float[Array, "*env n"]
    station: Float[Array, "*env"]
    ahead: Float[Array, "*env"]
    reckoning: Reckoning


def start(batch: tuple[int, ...], n_beams: int, shown: Senses = PLAIN) -> Reckoning:
    """Returns the reckoning at the start of an episode.

    Args:
        batch: Leading axes.
        n_beams: Number of beams of a scan.
        shown: Choice of the inputs.

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


def look(parts: Parts, begin: Float[Array, ""] | float, now: Reckoning) -> Sight:
    """Turns an observation into the network's inputs; call it once for each observation.

    Args:
        parts: `ranges` (m), `odometry` (distance, m, and heading, rad), `goal` (station, m), `ring_pitch` (m; 0 where
            there are no rings) and, in a task with a way back, `flag`, each with a last axis.
        begin: Believed station of the start, m.
        now: Reckoning so far.
    """
    reading, heading = parts["odometry"][..., 0], parts["odometry"][..., 1]
    goal, pitch = parts["goal"][..., 0] - begin, parts["ring_pitch"][..., 0]
    flag = parts["flag"][..., 0] if "flag" in parts else jnp.zeros_like(reading)
    flagged_at = jnp.where((flag > 0.5) & (now.flag < 0.5), heading, now.flagged_at)
    turned = jnp.abs(jnp.mod(heading - flagged_at + jnp.pi, 2.0 * jnp.pi) - jnp.pi)
    back = jnp.where((flag > 0.5) & (turned > _TURNED), 1.0, now.back)
    counter = tracker(now.senses.tracker)
    distance, near = counter.measure(now.step, reading - now.reading), now.boxes
    if near is not None:
        near = boxes.look(near, parts["ranges"], now.action, now.begun < 0.5, back > now.back)
        distance = distance * boxes.cosine(near)
    track = counter.advance(now.rings, parts["ranges"], distance, 1.0 - 2.0 * back, pitch)
    after = dataclasses.replace(
        now, rings=track, reading=reading, flag=flag, flagged_at=flagged_at, back=back, boxes=near
    )
    ahead = jnp.where(flag > 0.5, 0.0, goal) - track.station
    return Sight(_features(parts["ranges"], heading, ahead, pitch, after), track.station, ahead, after)


def advance(now: Reckoning, action: Float[Array, "*env 2"], done: Bool[Array, "*env"] | bool) -> Reckoning:
    """Returns the reckoning after an action (m/s and rad/s); at its start where the episode is `done`."""
    keep = 1.0 - jnp.broadcast_to(jnp.asarray(done, jnp.float32), now.begun.shape)
    step = PERIOD * jnp.maximum(action[..., 0], 0.0)
    return Reckoning(
        rings=tracker(now.senses.tracker).restart(now.rings, keep),
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


def replace_action(before: Reckoning, after: Reckoning, action: Float[Array, "*env 2"]) -> Reckoning:
    """Returns the reckoning as if another action had been taken.

    Args:
        before: Reckoning before the look that led to the action.
        after: Reckoning after the action that was not taken.
        action: Action that was taken instead, m/s and rad/s.
    """
    step = PERIOD * jnp.maximum(action[..., 0], 0.0)
    return dataclasses.replace(after, commanded=before.commanded + step, step=step, action=action)


def _features(
    ranges: Float[Array, "*env n_beams"],
    heading: Float[Array, "*env"],
    ahead: Float[Array, "*env"],
    pitch: Float[Array, "*env"],
    now: Reckoning,
) -> Float[Array, "*env n"]:
    """Returns the inputs of the network."""
    n_beams = ranges.shape[-1]
    side = np.abs(np.sin(np.arange(n_beams) * (2.0 * np.pi / n_beams))).astype(np.float32)
    # A pocket of 13 cm is nothing in 30 m; across the tunnel it is a third of the scale.
    across = jnp.clip((ranges * side - HALF_WIDTH) / 0.3, -3.0, 3.0)
    track, turn = now.rings, 2.0 * jnp.pi / jnp.maximum(pitch, 0.5)
    single: list[Any] = [
        jnp.sin(turn * track.station),
        jnp.cos(turn * track.station),
        jnp.clip(5.0 * track.innovation, -2.0, 2.0),
        track.strength,
        20.0 * track.rate,
        (track.station - track.reckoned) / 3.0,
        (now.reading - now.commanded) / 3.0,
        jnp.sin(heading),
        jnp.cos(heading),
        track.station / 100.0,
        jnp.tanh(ahead / 3.0),
        jnp.tanh(ahead / 30.0),
        (pitch - 1.35) / 0.15,
        jnp.minimum(now.begun, 10.0) / 10.0,
        now.flag,
        now.back,
    ]
    near = [] if now.boxes is None else [boxes.features(now.boxes)]
    return jnp.concatenate([across, ranges / 30.0, now.action, jnp.stack(single, axis=-1), *near], axis=-1)


PATCH = 4  # rows and columns of a patch of an image
IMAGE_RANGE = 30.0  # m, by which the ranges of an image are divided


def patches(image: Float[Array, "*env n"], shape: tuple[int, int]) -> Float[Array, "*env k 32"]:
    """Return the patches of an image of ranges, each pixel as its distance across the tunnel and as its range.

    Args:
        image: Ranges over 30 m, row by row.
        shape: Rows and columns, multiples of 4; columns go round the whole turn.
    """
    rows, columns = shape
    side = np.abs(np.sin(np.arange(columns) * (2.0 * np.pi / columns))).astype(np.float32)
    grid = image.reshape(*image.shape[:-1], rows, columns)
    across = jnp.clip((30.0 * grid * side - HALF_WIDTH) / 0.3, -3.0, 3.0)
    both = jnp.stack([across, grid], axis=-1)
    tiles = both.reshape(*image.shape[:-1], rows // PATCH, PATCH, columns // PATCH, PATCH, 2)
    return jnp.swapaxes(tiles, -4, -3).reshape(*image.shape[:-1], -1, 2 * PATCH * PATCH)


def aim(ahead: Float[Array, "*env"], log_sigma: Float[Array, "*env"]) -> Float[Array, "*env 5"]:
    """Returns the distance to go at several scales, from the last decimetres on.

    Args:
        ahead: Goal less estimated station, m.
        log_sigma: Log of the standard deviation of the estimate, m.
    """
    scaled = [jnp.tanh(ahead / scale) for scale in (0.5, 2.0, 10.0)]
    return jnp.stack([*scaled, jnp.clip(ahead / 100.0, -1.0, 4.0), log_sigma], axis=-1)


def bin_centres(bins: int, width: float) -> Float[np.ndarray, "bins"]:
    """Returns the centres of the bins of the estimation head, m of true less tracked distance."""
    return ((np.arange(bins) - 0.5 * (bins - 1)) * width).astype(np.float32)
