"""Motion of a sensor through a bore as people record it, a rest, a way with a stop and turns, a rest; its odometer.

All parts are smooth to the second derivative, so that accelerations exist and a rest is a rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.survey.bore import Bore
from scene.survey.carrier import Poses
from scene.survey.lidar import SCAN_PERIOD

MotionName = Literal["trolley", "walk", "b2"]
REST = 3.0  # s without motion at the start, in which a program finds gravity and the biases of its IMU
_RAMP, _PAUSE, _END = 2.0, 2.0, 1.5  # s: to speed or to a halt; of the stop on the way; of the rest at the end


def ramp_up(time: Float[np.ndarray, "n"], begin: float, run: float) -> Float[np.ndarray, "n"]:
    """Returns a step from 0 to 1 that takes `run` s from `begin` on, smooth to the second derivative."""
    u = np.clip((time - begin) / run, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u * u)


def ramp_area(time: Float[np.ndarray, "n"], begin: float, run: float) -> Float[np.ndarray, "n"]:
    """Returns the integral of `ramp_up` since `begin`, s."""
    u = np.clip((time - begin) / run, 0.0, 1.0)
    return run * u**4 * (2.5 - 3.0 * u + u * u) + np.maximum(time - begin - run, 0.0)


@dataclass(frozen=True)
class Tremor:
    """Periodic motion about a mean: a sum of cosines."""

    amplitude: Float[np.ndarray, "k"]  # One for each cosine, m or rad
    rate: Float[np.ndarray, "k"]  # Its frequency, Hz
    phase: Float[np.ndarray, "k"]  # Its phase, rad

    def __call__(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Returns the value at `time`, s."""
        return np.cos(2.0 * np.pi * np.outer(time, self.rate) + self.phase) @ self.amplitude


@dataclass(frozen=True)
class Carrier:
    """A way of carrying a LiDAR."""

    speed: float  # Cruising speed, m/s
    height: float  # Height of the LiDAR over the floor, m
    turn: float  # Turn to the left and back during the stop, rad
    # Amplitude and frequency of the beat of steps or wheels, for each of ahead, across, up (m), yaw, pitch and roll
    # (rad); frequencies in Hz
    shake: tuple[tuple[float, float], ...]
    sway: tuple[float, ...]  # Standard deviation of the slow sway, 0.05 to 0.4 Hz, of the same six


_DEGREE = np.pi / 180.0
# A person's steps: 1.8 Hz, as in `scene.survey`. The B2 trots with 2 strides a second (`subterra_jax.b2.gait`): the
# trunk bobs and pitches with each pair of feet, twice a stride, and rolls once. Its amplitudes, and all of the
# trolley's, are assumptions of the size that such carriers show. The released gait in MuJoCo, over sleepers at 0.8 m/s,
# keeps to these frequencies, and bobs with the sleepers besides; its amplitudes are 3, 3 and 11 mm, 1.2° of roll, 1.0°
# of pitch and 0.3° of yaw.
CARRIERS: dict[MotionName, Carrier] = {
    "trolley": Carrier(
        1.5, 1.5, 0.0,
        ((0.0, 1.0), (0.001, 7.0), (0.001, 11.0), (0.0, 1.0), (0.05 * _DEGREE, 9.0), (0.05 * _DEGREE, 7.0)),
        (0.0, 0.005, 0.002, 0.3 * _DEGREE, 0.1 * _DEGREE, 0.1 * _DEGREE),
    ),
    "walk": Carrier(
        1.2, 1.6, 40.0 * _DEGREE,
        ((0.008, 1.8), (0.015, 0.9), (0.02, 1.8), (0.5 * _DEGREE, 0.9), (0.6 * _DEGREE, 1.8), (0.5 * _DEGREE, 0.9)),
        (0.1, 0.12, 0.02, 7.0 * _DEGREE, 4.0 * _DEGREE, 2.0 * _DEGREE),
    ),
    "b2": Carrier(
        1.0, 0.75, 90.0 * _DEGREE,
        ((0.006, 4.0), (0.008, 2.0), (0.008, 4.0), (0.4 * _DEGREE, 2.0), (0.6 * _DEGREE, 4.0), (1.0 * _DEGREE, 2.0)),
        (0.02, 0.05, 0.004, 1.5 * _DEGREE, 0.4 * _DEGREE, 0.4 * _DEGREE),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Drive:
    """A LiDAR's way through a bore: rest, half of the way, stop, the other half, rest."""

    bore: Bore  # Bore driven through
    carrier: Carrier  # Way of carrying
    begin: float  # Station of the start, m
    distance: float  # Length of the way, m
    tremors: tuple[Tremor, ...]  # Motion about the way: ahead, across, up, yaw, pitch, roll

    @property
    def knots(self) -> tuple[float, ...]:
        """Times at which the carrier starts, slows down, starts again and slows down again, s."""
        run = 0.5 * self.distance / self.carrier.speed  # from the start of a ramp up to the start of the one down
        again = REST + run + _RAMP + _PAUSE
        return REST, REST + run, again, again + run

    @property
    def duration(self) -> float:
        """Length of the recording, a whole number of sweeps, s."""
        return float(SCAN_PERIOD * np.ceil((self.knots[-1] + _RAMP + _END) / SCAN_PERIOD))

    def station(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        signs = (1.0, -1.0, 1.0, -1.0)
        areas = (sign * ramp_area(time, at, _RAMP) for sign, at in zip(signs, self.knots, strict=True))
        return self.begin + self.carrier.speed * sum(areas, np.zeros_like(time)) + self._tremor(0, time)

    def _moves(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Returns 0 at rest at both ends and 1 between; tremors also die out in the stop."""
        start, slow, again, end = self.knots
        first = ramp_up(time, start, _RAMP) - ramp_up(time, slow, _RAMP)
        return first + ramp_up(time, again, _RAMP) - ramp_up(time, end, _RAMP)

    def _tremor(self, part: int, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return self._moves(time) * self.tremors[part](time)

    def poses(self, time: Float[np.ndarray, "n"]) -> Poses:
        station = self.station(time)
        frames = self.bore.alignment.frames(station)
        above = self.carrier.height - 0.5 * self.bore.section.height(station) + self._tremor(2, time)
        yaw, pitch, roll = (self._tremor(part, time) for part in (3, 4, 5))
        halt = self.knots[1] + _RAMP
        yaw = yaw + self.carrier.turn * (ramp_up(time, halt - 1.0, 1.5) - ramp_up(time, halt + 0.5, 1.5))
        attitude = Rotation.from_matrix(frames.matrix) * Rotation.from_euler(
            "ZYX", np.stack([yaw, -pitch, roll], axis=-1)
        )
        return Poses(frames.point(self._tremor(1, time), above), attitude.as_quat())


def draw_drive(rng: np.random.Generator, bore: Bore, motion: MotionName, begin: float, distance: float) -> Drive:
    """Draws a drive from a station, m, over a distance, m."""
    carrier = CARRIERS[motion]
    tremors = [_draw_tremor(rng, *beat, sway) for beat, sway in zip(carrier.shake, carrier.sway, strict=True)]
    return Drive(bore, carrier, begin, distance, tuple(tremors))


def _draw_tremor(rng: np.random.Generator, amplitude: float, rate: float, sway: float) -> Tremor:
    slow: Sequence[float] = rng.uniform(0.05, 0.4, 6).tolist()
    amplitudes = np.array([amplitude, *[sway * np.sqrt(2.0 / 6.0)] * 6])
    return Tremor(amplitudes, np.array([rate * rng.uniform(0.97, 1.03), *slow]), rng.uniform(0.0, 2.0 * np.pi, 7))


# Wheel odometry with the errors of real corridors: one scale error a robot, which wanders along the way. Source of the
# sizes: +2.2 % in scale, standard deviation 0.6 % from one 20 m to the next, over 864 m of a real robot's corridors,
# always of one sign.
WHEEL_RATE = 50.0  # Hz
_SCALE, _SCALE_SIGMA, _SCALE_PIECE = 0.022, 0.006, 20.0  # 1; 1; m
_TURN_SIGMA = 2e-4  # rad/√m, wander of the heading


def measure_wheels(
    rng: np.random.Generator, station: Float[np.ndarray, "n"], poses: Poses
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]]:
    """Simulates the odometer of one robot.

    Args:
        rng: Draws the robot's sign, its scale errors and the wander of its heading.
        station: True station at each time, m, `(n,)`.
        poses: True poses of the LiDAR.

    Returns:
        Poses of the LiDAR in the odometer's frame, which is that of the first pose, levelled: positions, m, `(n, 3)`,
        and quaternions x, y, z, w, `(n, 4)`. Height, roll and pitch are 0: wheels do not see them.
    """
    sign = rng.choice([-1.0, 1.0])
    driven = np.abs(np.diff(station, prepend=station[0])).cumsum()
    scale = sign * rng.normal(_SCALE, _SCALE_SIGMA, int(driven[-1] // _SCALE_PIECE) + 1)
    piece = (driven / _SCALE_PIECE).astype(int).clip(0, len(scale) - 1)
    step = np.diff(station, prepend=station[0]) * (1.0 + scale[piece])
    yaw = Rotation.from_quat(poses.quaternion).as_euler("ZYX")[:, 0]
    drift = _TURN_SIGMA * np.sqrt(np.diff(driven, prepend=0.0)) * rng.standard_normal(len(driven))
    wander = drift.cumsum()
    # The wheels roll along a straight bore; where the LiDAR looks does not steer them.
    way = [(step * np.cos(wander)).cumsum(), (step * np.sin(wander)).cumsum(), np.zeros(len(step))]
    heading = np.unwrap(yaw) - yaw[0] + wander
    return np.column_stack(way), Rotation.from_euler("Z", heading[:, None]).as_quat()
