"""The walk: a person carries the LiDAR through the bore.

The Avia looks ahead, and meets the crown only some 6 m in front of itself. The walk therefore starts 10 m before the
first mouth, outside, so that the section is seen whole from station 0 on; it ends 2 m before the second mouth.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.survey.bore import Bore
from scene.survey.mount import Mount

START, STOP = -10.0, -2.0  # m: from the first mouth; from the second
CARRY_HEIGHT = 1.6  # m above the floor
_TABLE = 1e-3  # s, spacing of the pose table; linear in between, good to 0.01 mm and 1e-6 rad


@dataclass(frozen=True)
class Sway:
    """A sum of sinusoids.

    Attributes:
        amplitude: One for each sinusoid, in the unit of the sway.
        rate: rad/s.
        phase: rad.
    """

    amplitude: Float[np.ndarray, "k"]
    rate: Float[np.ndarray, "k"]
    phase: Float[np.ndarray, "k"]

    def __call__(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Value at `time`, s."""
        return np.cos(np.outer(time, self.rate) + self.phase) @ self.amplitude


def _draw_sway(rng: np.random.Generator, slow: float, stride: float) -> Sway:
    """Slow sway of 0.04 to 0.4 Hz with standard deviation `slow`, and the beat of the steps with amplitude `stride`."""
    rate = 2.0 * np.pi * np.concatenate([rng.uniform(0.04, 0.4, 6), rng.uniform(1.7, 1.9, 1)])
    amplitude = np.concatenate([np.full(6, slow * np.sqrt(2.0 / 6.0)), [stride]])
    return Sway(amplitude, rate, rng.uniform(0.0, 2.0 * np.pi, 7))


@dataclass(frozen=True)
class Poses:
    """LiDAR poses in the survey frame.

    Attributes:
        position: m.
        quaternion: x, y, z, w; takes LiDAR vectors to the survey frame.
    """

    position: Float[np.ndarray, "n 3"]
    quaternion: Float[np.ndarray, "n 4"]


@dataclass(frozen=True)
class Walk:
    """The carried LiDAR's motion.

    Attributes:
        bore: The bore walked through.
        speed: Mean speed, m/s.
        duration: Length of the survey, s.
        ahead, across, above: Sway of the position, m.
        yaw, pitch, roll: Sway of the attitude against the centreline's frame, rad.
    """

    bore: Bore
    speed: float
    duration: float
    ahead: Sway
    across: Sway
    above: Sway
    yaw: Sway
    pitch: Sway
    roll: Sway

    def station(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Station of the carrier, m."""
        return START + self.speed * time + self.ahead(time)

    def poses(self, time: Float[np.ndarray, "n"]) -> Poses:
        """Exact poses at `time`, s."""
        station = self.station(time)
        frames = self.bore.alignment.frames(station)
        above = CARRY_HEIGHT - 0.5 * self.bore.section.height(station) + self.above(time)
        turns = np.stack([self.yaw(time), -self.pitch(time), self.roll(time)], axis=-1)
        attitude = Rotation.from_matrix(frames.matrix) * Rotation.from_euler("ZYX", turns)
        return Poses(frames.point(self.across(time), above), attitude.as_quat())


@dataclass(frozen=True)
class Carried:
    """An instrument on the walk.

    Attributes:
        walk: Motion of the rack, which is that of the Avia's frame.
        mount: Of the instrument against the Avia.
    """

    walk: Walk
    mount: Mount

    def poses(self, time: Float[np.ndarray, "n"]) -> Poses:
        """Exact poses at `time`, s."""
        rack = self.walk.poses(time)
        attitude = Rotation.from_quat(rack.quaternion)
        quaternion = (attitude * Rotation.from_matrix(self.mount.rotation.T)).as_quat()
        # One sign throughout, so that neighbours can be interpolated.
        flips = np.cumprod(np.where((quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
        quaternion[1:] *= flips[:, None]
        return Poses(rack.position + attitude.apply(self.mount.origin), quaternion)

    def poses_between(self, begin: float, time: Float[np.ndarray, "n"]) -> Poses:
        """Poses at many sorted `time`, s, not before `begin`, by a table of exact poses; quick."""
        knots = begin + _TABLE * np.arange(int(np.ceil((time[-1] - begin) / _TABLE)) + 2)
        exact = self.poses(knots)
        place = (time - begin) / _TABLE
        low = np.minimum(place.astype(np.int64), len(knots) - 2)
        share = (place - low)[:, None]
        position = exact.position[low] + share * (exact.position[low + 1] - exact.position[low])
        quaternion = exact.quaternion[low] + share * (exact.quaternion[low + 1] - exact.quaternion[low])
        return Poses(position, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))


def draw_walk(rng: np.random.Generator, bore: Bore, speed: float, period: float) -> Walk:
    """Draw a walk through `bore`, a whole number of scans of `period` s long."""
    duration = period * np.ceil((bore.alignment.length + STOP - START) / speed / period)
    degree = np.pi / 180.0
    return Walk(
        bore,
        speed,
        float(duration),
        # Progress sways with the speed, so that nobody walks backwards.
        ahead=_draw_sway(rng, 0.1 * speed, 0.008 * speed),
        across=_draw_sway(rng, 0.12, 0.015),
        above=_draw_sway(rng, 0.02, 0.02),
        # The carrier looks about a little, which lets the LiDAR see deeper into the pockets beside it.
        yaw=_draw_sway(rng, 7.0 * degree, 0.5 * degree),
        pitch=_draw_sway(rng, 4.0 * degree, 0.6 * degree),
        roll=_draw_sway(rng, 2.0 * degree, 0.5 * degree),
    )


def rotate(quaternion: Float[np.ndarray, "n 4"], vector: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Vectors turned by unit quaternions x, y, z, w."""
    axis, w = quaternion[:, :3], quaternion[:, 3:]
    twice = 2.0 * np.cross(axis, vector)
    return vector + w * twice + np.cross(axis, twice)
