"""The contract of a part, and what the environment hands to parts and rules during a step.

reset:  draw_reset ─► begin
step:   draw_step ─► drive ─► clearance ─► advance ─► (rule) judge
scan:   look_from ─► hits, corrupt ─► observe
"""

from __future__ import annotations

import abc
import dataclasses
import zlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

if TYPE_CHECKING:
    from subterra_jax.state import EnvParams, State
    from subterra_jax.tunnel import Foot, Tunnel

Bounds = tuple[Any, Any]  # lowest and highest values: two numbers, or two arrays of the entry's shape
Batch = tuple[int, ...]
Keys = Any  # one key, or `(k,)` keys for k random streams


@struct.dataclass
class Noise:
    """Random numbers of one part for one step; `()` where it asked for none.

    Attributes:
        normal: Standard normal numbers, `(normals,)`.
        uniform: Uniform numbers in [0, 1), `(uniforms,)`.
    """

    normal: Any = ()
    uniform: Any = ()


@dataclasses.dataclass(frozen=True)
class Drive:
    """Motion of one step, between the command and the ground."""

    wheels: Float[Array, 2]  # speed (m/s) and yaw rate (rad/s) of the wheels, which the odometer counts
    motion: Float[Array, 2]  # speed and yaw rate of the robot itself


@dataclasses.dataclass(frozen=True)
class Moved:
    """Result of a motion."""

    position: Float[Array, 2]  # position afterwards, tunnel frame, m
    heading: Float[Array, ""]  # heading afterwards, rad, in [-π, π]
    drive: Drive  # mean motion during the step
    own: Any  # state of the motion part afterwards
    clearance: Any  # least distance to a wall during the step, m; read only where the motion is not `on_the_plan`
    contact: Any  # the motion itself met an obstacle
    fallen: Any  # the robot can go on no further; ends the episode
    info: dict[str, Array]  # further entries of `info`


@dataclasses.dataclass(frozen=True)
class Step:
    """One step after the motion, as parts and the rule see it.

    Attributes:
        before: State before the step.
        tunnel: Tunnel that the robot is in.
        place: Foot of the new position on the centreline.
        position: New position, tunnel frame, m.
        heading: New heading, rad.
        furthest: Furthest station of the episode, m.
        contact: The robot touches a wall or an obstacle, or has fallen.
        command: Command obeyed, m/s and rad/s.
        drive: Motion of the wheels and of the robot.
        moved: True distance of this step, m.
        report: Estimated station (m), log of its standard deviation, direction (above 0: growing station); zeros where
            the action has none.
        after: States of the parts that have advanced already, by name.
    """

    before: State
    tunnel: Tunnel
    place: Foot
    position: Float[Array, 2]
    heading: Float[Array, ""]
    furthest: Float[Array, ""]
    contact: Bool[Array, ""]
    command: Float[Array, 2]
    drive: Drive
    moved: Float[Array, ""]
    report: Float[Array, 3]
    after: Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class SensingState:
    """The state that sensors show: the present one, or an earlier one where observations are late.

    Attributes:
        tunnel: Tunnel that the robot is in.
        position: Position, tunnel frame, m.
        heading: Heading, rad.
        station: Station, m.
        parts: States of the parts, by name.
        needed: Someone will read the observation; where not, ranges may be anything.
        hits: From beam directions `(n_beams, 2)` to distances to obstacles, m; `inf` where there are none.
        corrupt: From true ranges to ranges with dust and lost beams, m.
    """

    tunnel: Tunnel
    position: Float[Array, 2]
    heading: Float[Array, ""]
    station: Float[Array, ""]
    parts: Mapping[str, Any]
    needed: Any = True
    hits: Callable[[Array], Any] = lambda directions: np.inf
    corrupt: Callable[[Array], Array] = lambda ranges: ranges


@struct.dataclass
class Boxes:
    """A few boxes in the tunnel frame."""

    centre: Float[Array, "n 2"]  # middles, m; far away where there is none
    axis: Float[Array, "n 2"]  # unit vectors along the first side
    half: Float[Array, "n 2"]  # half sides, m, the first along `axis`


class Part(abc.ABC):
    """One part of an environment: a sensor, an error, an obstacle. Static and hashable; a frozen dataclass.

    Numbers that may be randomised live in its params, what changes lives in its state. Every method has a default that
    does nothing, so a part writes only what it needs. All functions are of one environment; batches come by `vmap`.

    Attributes:
        name: Name of its state, and of its random numbers.
        place: Place of its entries in the observation, lowest first: LiDAR 0, odometer 1, rule 2, others 3.
        streams: Numbers of its random streams at a reset; by default one, made from the name.
    """

    name: ClassVar[str]
    place: ClassVar[int] = 3
    streams: ClassVar[tuple[int, ...]] = ()

    def defaults(self) -> dict[str, Any]:
        """Entries of `EnvParams` that the part reads, by name, with their default values."""
        return {}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> Any:
        """Draw what an episode needs, for a whole batch at once.

        Args:
            key: A key of the part's own; `(len(streams),)` keys where it has several streams.
            batch: Leading axes of every array returned.
        """
        return ()

    def normals(self, params: EnvParams) -> int:
        """Count the standard normal numbers that one step takes."""
        return 0

    def uniforms(self, params: EnvParams) -> int:
        """Count the uniform numbers that one step takes."""
        return 0

    def begin(self, draw: Any, state: State, params: EnvParams) -> Any:
        """Make the part's state at the start of an episode.

        Args:
            state: The robot at its start, with the states of the parts before this one.
        """
        return ()

    def drive(self, own: Any, drive: Drive, state: State, params: EnvParams) -> Drive:
        """Change the motion between command and ground, as slip does."""
        return drive

    def clearance(self, own: Any, position: Array, station: Array, tunnel: Tunnel, params: EnvParams) -> Any:
        """Measure the distance from a point to what the part puts into the tunnel, m; `inf` for nothing."""
        return np.inf

    def advance(self, own: Any, step: Step, noise: Noise, params: EnvParams) -> Any:
        """Return the part's state after a step."""
        return own

    def look_from(self, own: Any, sensing: SensingState, params: EnvParams) -> SensingState:
        """Change the state that sensors show, as a delay does."""
        return sensing

    def hits(self, own: Any, sensing: SensingState, directions: Float[Array, "n_beams 2"], params: EnvParams) -> Any:
        """Measure how far along each beam the part's obstacles are met, m; `inf` for none."""
        return np.inf

    def corrupt(self, own: Any, ranges: Float[Array, n_beams], noise: Noise, params: EnvParams) -> Array:
        """Change true ranges, as dust does."""
        return ranges

    def observe(self, own: Any, sensing: SensingState, noise: Noise, params: EnvParams) -> dict[str, Array]:
        """Return the part's entries of the observation by name, each `(n,)` or a single number."""
        return {}

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        """Return lowest and highest values of each entry of `observe`, in the same order; numbers may be traced."""
        return {}

    def images(self, params: EnvParams) -> dict[str, tuple[int, int]]:
        """Return rows and columns of the entries that are images, row by row in the observation."""
        return {}

    def check(self, others: frozenset[str], params: EnvParams) -> None:
        """Refuse params that the part cannot honour, or parts that it does not go with.

        Raises:
            ValueError: It cannot.
        """
        del others, params

    def privileged(self, own: Any) -> dict[str, Array]:
        """Return what a teacher or a critic may know of the part, and an agent may not."""
        return {}

    def info(self, own: Any) -> dict[str, Array]:
        """Return the part's entries of `info`."""
        return {}

    def levels(self, params: EnvParams) -> range:
        """Return the levels of difficulty that an evaluation goes through evenly; empty for a part without."""
        return range(0)

    def at_level(self, params: EnvParams, level: Any) -> EnvParams:
        """Return the params with one level of difficulty."""
        return params

    def boxes(self, own: Any, station: Array, tunnel: Tunnel, params: EnvParams) -> list[Boxes]:
        """Return boxes near a station, for pictures."""
        return []

    def skips_unneeded(self, params: EnvParams) -> bool:
        """Tell whether a batch of observations costs little for those that nobody wants."""
        return False

    @classmethod
    def random_streams(cls) -> tuple[int, ...]:
        """Return the numbers of the part's random streams."""
        return cls.streams or (zlib.crc32(cls.name.encode()) | 1 << 31,)


class Motion(Part):
    """The part that moves the robot: wheels, or legs.

    Attributes:
        on_the_plan: The robot's distance to the walls is measured in the planar tunnel after the motion; otherwise
            `Moved.clearance` says it.
    """

    on_the_plan: ClassVar[bool] = True

    def draw_step(self, key: PRNGKeyArray, batch: Batch, params: EnvParams) -> Any:
        """Draw what a motion needs beside `normals` and `uniforms`, for a whole batch at once."""
        return ()

    def in_tunnel(self, params: EnvParams, tunnel: Any) -> EnvParams:
        """Return params that hold one tunnel of a stack in place of all of them."""
        return params.replace(tunnel=params.tunnel.pick(tunnel))

    @abc.abstractmethod
    def obey(self, action: Float[Array, n_action], state: State, params: EnvParams) -> Float[Array, 2]:
        """Return the command that the robot obeys: the action within its limits, a NaN read as 0."""

    @abc.abstractmethod
    def move(self, state: State, drive: Drive, noise: Any, tunnel: Tunnel, params: EnvParams) -> Moved:
        """Move the robot for one control period.

        Args:
            drive: The clipped command as the other parts have changed it.
        """


def uniform_at(seed: UInt32[Array, ""], slot: Int[Array, "*n"], index: int) -> Float[Array, "*n"]:
    """Return uniform numbers in [0, 1) of places: equal for equal seed and slot, and never stored.

    Args:
        seed: Seed of the episode.
        slot: Places.
        index: Number of the draw at a place; any small constant.

    Source: the finaliser of MurmurHash3 (Appleby), twice, because slots are consecutive.
    """
    mixed = slot.astype(jnp.uint32) * jnp.uint32(0x9E3779B1) + jnp.uint32((index * 0x85EBCA77 + 1) & 0xFFFFFFFF)
    mixed = _finish(_finish(mixed) ^ seed)
    return (mixed >> 8).astype(jnp.float32) * jnp.float32(2.0**-24)


def _finish(bits: UInt32[Array, "*n"]) -> UInt32[Array, "*n"]:
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    return bits ^ (bits >> 16)
