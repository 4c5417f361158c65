"""The walk of a person who carries the LiDAR through the bore, and what IMUs and total station measure along it.

The Avia looks ahead, and meets the crown only some 6 m in front of itself. The walk therefore starts 10 m before the
first mouth, outside, so that the section is seen whole from station 0 on; it ends 2 m before the second mouth.

The rack has three LiDARs, their IMUs and a prism, after GEODE's devices α, β and γ. All three devices of GEODE's
tunnelling runs hang on one rack, and its scripts place each LiDAR against a common target: β and γ against the total
station's prism, α and γ against the GNSS antenna. That is where the mounts come from.

Source: PengYu-Team/GEODE_dataset, evaluation scripts and calibration files [geode.md].
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.survey.bore import Bore
from scene.survey.config import LidarName, SensorErrors
from scene.survey.section import draw_field


@dataclass(frozen=True)
class Mount:
    """Transform between two instruments: p_instrument = rotation @ p_other + shift."""

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]  # m

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """The instrument's origin in the other's coordinates, m."""
        return -self.rotation.T @ self.shift

    def after(self, first: "Mount") -> "Mount":
        return Mount(self.rotation @ first.rotation, self.rotation @ first.shift + self.shift)

    def inverse(self) -> "Mount":
        return Mount(self.rotation.T, self.origin)


def _target(shift: list[float], wxyz: list[float]) -> Mount:
    return Mount(Rotation.from_quat([*wxyz[1:], wxyz[0]]).as_matrix(), np.array(shift))


# LiDAR coordinates to those of the target, as printed: t, q as w x y z.
PRISM = _target([0.00947221, -0.308202, -0.365733], [0.999901, -0.00492765, 0.00575961, 0.0117651])  # of γ
_PRISM_BETA = _target([-0.0108864, 0.293397, -0.452674], [0.999991, 0.000903519, 0.0035434, -0.00220342])
_GNSS_GAMMA = _target([0.0305, -0.5959, 0.0902], [0.9998828, -0.0057758, 0.0022253, 0.0140019])
_GNSS_ALPHA = _target([0.0090, -0.2925, 0.4533], [0.9999909, -0.0009, -0.00355, 0.0022])

# Each LiDAR against the Avia: p_lidar = rotation @ p_avia + shift.
LIDARS: dict[LidarName, Mount] = {
    "avia": Mount(np.eye(3), np.zeros(3)),
    "vlp16": _GNSS_ALPHA.inverse().after(_GNSS_GAMMA),
    "os1": _PRISM_BETA.inverse().after(PRISM),
}


@dataclass(frozen=True)
class Imu:
    """An IMU of one device."""

    topic: str  # Topic of its messages
    frame: str  # Its frame id
    rate: float  # Samples per second, Hz
    mount: Mount  # Against the device's LiDAR
    in_g: bool = False  # True where accelerations are published in g
    orientation: bool = False  # True where it estimates its orientation


def _mti(rotation: list[list[float]], shift: list[float]) -> Imu:
    u, _, vt = np.linalg.svd(np.array(rotation))  # printed digits are made orthonormal
    return Imu("/imu/data", "imu_link", 100.0, Mount(u @ vt, np.array(shift)), orientation=True)


IMUS: dict[LidarName, tuple[Imu, ...]] = {
    "avia": (
        # In the housing, axes parallel; the offset is the one FAST-LIO ships. The driver publishes g.
        Imu("/livox/imu", "livox_frame", 200.0, Mount(np.eye(3), np.array([0.04165, 0.02326, -0.0284])), in_g=True),
        _mti(
            [[0.99962, 0.027463, 0.002445], [-0.027517, 0.999299, 0.025398], [-0.001746, -0.025456, 0.999674]],
            [0.049258, -0.0125, 0.026946],
        ),
    ),
    "vlp16": (
        _mti([[0.9999, 0.0049, 0.0153], [-0.0050, 1.0, 0.0021], [-0.0153, -0.0022, 0.9999]], [0.0961, -0.1338, 0.3032]),
    ),
    "os1": (
        # In the housing, axes parallel: 6.253, -11.775, 7.645 mm in Ouster's manual.
        Imu("/ouster/imu", "os_imu", 100.0, Mount(np.eye(3), np.array([-0.006253, 0.011775, -0.007645]))),
        _mti(
            [[0.998638, 0.052001, -0.004278], [-0.051937, 0.998554, 0.0139], [0.004994, -0.013659, 0.999894]],
            [-0.027172, -0.034873, 0.062643],
        ),
    ),
}


def calibration(name: LidarName) -> dict[str, Any]:
    """Return the content of a calibration file of one device, per docs/formats.md."""
    imus = {
        imu.topic: {key: np.round(getattr(imu.mount, key), 9).tolist() for key in ("rotation", "shift")}
        for imu in IMUS[name]
    }
    prism = LIDARS[name].rotation @ PRISM.origin + LIDARS[name].shift  # in the coordinates of the LiDAR, m
    return {"prism": np.round(prism, 9).tolist(), "imu": imus}


START, STOP = -10.0, -2.0  # m: from the first mouth; from the second
CARRY_HEIGHT = 1.6  # m above the floor
_TABLE = 1e-3  # s, spacing of the pose table; linear in between, good to 0.01 mm and 1e-6 rad


@dataclass(frozen=True)
class Sway:
    """A sum of sinusoids."""

    amplitude: Float[np.ndarray, "k"]  # One for each sinusoid, in the unit of the sway
    rate: Float[np.ndarray, "k"]  # rad/s
    phase: Float[np.ndarray, "k"]  # rad

    def __call__(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return np.cos(np.outer(time, self.rate) + self.phase) @ self.amplitude


def _draw_sway(rng: np.random.Generator, slow: float, stride: float) -> Sway:
    """Draws slow sway of 0.04 to 0.4 Hz (standard deviation `slow`) and the beat of steps (amplitude `stride`)."""
    rate = 2.0 * np.pi * np.concatenate([rng.uniform(0.04, 0.4, 6), rng.uniform(1.7, 1.9, 1)])
    amplitude = np.concatenate([np.full(6, slow * np.sqrt(2.0 / 6.0)), [stride]])
    return Sway(amplitude, rate, rng.uniform(0.0, 2.0 * np.pi, 7))


@dataclass(frozen=True)
class Poses:
    """LiDAR poses in the survey frame."""

    position: Float[np.ndarray, "n 3"]  # m
    quaternion: Float[np.ndarray, "n 4"]  # x, y, z, w; takes LiDAR vectors to the survey frame


class Motion(Protocol):
    """The motion of a rack along a bore: a carried `Walk`, or a drive of `benchmarks.slam.arena`."""

    @property
    def duration(self) -> float:
        """Length of the recording, s."""

    def station(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the station of the carrier, m."""

    def poses(self, time: Float[np.ndarray, "n"]) -> Poses:
        """Return the exact poses at `time`, s."""


@dataclass(frozen=True)
class Walk:
    """The carried LiDAR's motion."""

    bore: Bore  # The bore walked through
    speed: float  # Mean speed, m/s
    duration: float  # Length of the survey, s
    ahead: Sway  # Sway of the position along the centreline, m
    across: Sway  # Sway of the position to the left, m
    above: Sway  # Sway of the position upwards, m
    yaw: Sway  # Sway of the attitude against the centreline's frame, rad
    pitch: Sway  # rad
    roll: Sway  # rad

    def station(self, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return START + self.speed * time + self.ahead(time)

    def poses(self, time: Float[np.ndarray, "n"]) -> Poses:
        station = self.station(time)
        frames = self.bore.alignment.frames(station)
        above = CARRY_HEIGHT - 0.5 * self.bore.section.height(station) + self.above(time)
        turns = np.stack([self.yaw(time), -self.pitch(time), self.roll(time)], axis=-1)
        attitude = Rotation.from_matrix(frames.matrix) * Rotation.from_euler("ZYX", turns)
        return Poses(frames.point(self.across(time), above), attitude.as_quat())


@dataclass(frozen=True)
class Carried:
    """An instrument on the walk."""

    walk: Motion  # Motion of the rack, which is that of the Avia's frame
    mount: Mount  # Mount of the instrument against the Avia

    def poses(self, time: Float[np.ndarray, "n"]) -> Poses:
        rack = self.walk.poses(time)
        attitude = Rotation.from_quat(rack.quaternion)
        quaternion = (attitude * Rotation.from_matrix(self.mount.rotation.T)).as_quat()
        # One sign throughout, so that neighbours can be interpolated.
        flips = np.cumprod(np.where((quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
        quaternion[1:] *= flips[:, None]
        return Poses(rack.position + attitude.apply(self.mount.origin), quaternion)

    def poses_between(self, begin: float, time: Float[np.ndarray, "n"]) -> Poses:
        """Return poses at many sorted `time`, s, not before `begin`, from a table of exact poses; quick."""
        knots = begin + _TABLE * np.arange(int(np.ceil((time[-1] - begin) / _TABLE)) + 2)
        exact = self.poses(knots)
        place = (time - begin) / _TABLE
        low = np.minimum(place.astype(np.int64), len(knots) - 2)
        fraction = (place - low)[:, None]
        position = exact.position[low] + fraction * (exact.position[low + 1] - exact.position[low])
        quaternion = exact.quaternion[low] + fraction * (exact.quaternion[low + 1] - exact.quaternion[low])
        return Poses(position, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))


def draw_walk(rng: np.random.Generator, bore: Bore, speed: float, period: float) -> Walk:
    """Draws a walk through `bore`, a whole number of scans of `period` s long."""
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
    """Turns vectors by unit quaternions x, y, z, w."""
    axis, w = quaternion[:, :3], quaternion[:, 3:]
    twice = 2.0 * np.cross(axis, vector)
    return vector + w * twice + np.cross(axis, twice)


GRAVITY = 9.80665  # m/s²
PRISM_RATE = 3.0  # Hz
ACCEL_BIAS, GYRO_BIAS = 0.02, 0.003  # m/s², rad/s; standard deviation of the constant part in each axis
# GEODE's γ figures [geode.md], used for every IMU here. As standard deviations of one sample they agree with the
# MTi-30's data sheet (0.03 °/s/√Hz, 60 µg/√Hz at 100 Hz); as densities they would be ten times worse than it.
ACCEL_SIGMA, ACCEL_WALK = 5.574e-3, 1.208e-4  # m/s², m/s²/√s
GYRO_SIGMA, GYRO_WALK = 5.144e-3, 1.088e-4  # rad/s, rad/s/√s
_H = 1e-3  # s, half-step of the central differences


@dataclass(frozen=True)
class Inertial:
    """Samples of one IMU."""

    time: Float[np.ndarray, "n"]  # s since the start
    accel: Float[np.ndarray, "n 3"]  # Specific force, m/s²; +9.8 upwards at rest
    gyro: Float[np.ndarray, "n 3"]  # rad/s
    quaternion: Float[np.ndarray, "n 4"]  # Orientation x, y, z, w, IMU to a level frame of unknown heading


def measure_inertial(
    rng: np.random.Generator, lidar: Carried, rate: float, mount: Mount, errors: SensorErrors
) -> Inertial:
    """Simulates an IMU, `mount` against the LiDAR, that samples at `rate`, Hz.

    With `imu_noise`, roll and pitch of its orientation are off by 0.2° (1 σ), slowly changing; its heading is
    magnetic, so it has an offset of up to 15° and wanders by 1°.
    """
    time = np.arange(round(lidar.walk.duration * rate)) / rate
    turn = Rotation.from_matrix(mount.rotation.T)

    def state(at: np.ndarray) -> tuple[np.ndarray, Rotation]:
        poses = lidar.poses(at)
        attitude = Rotation.from_quat(poses.quaternion)
        return poses.position + attitude.apply(mount.origin), attitude * turn

    (before, r_before), (here, r_here), (after, r_after) = (state(time + k * _H) for k in (-1.0, 0.0, 1.0))
    force = (after - 2.0 * here + before) / _H**2 + (0.0, 0.0, GRAVITY)
    accel = r_here.inv().apply(force)
    gyro = (r_before.inv() * r_after).as_rotvec() / (2.0 * _H)

    n, noise, bias = len(time), float(errors.imu_noise), float(errors.imu_bias)
    walks = rng.standard_normal((2, n, 3)).cumsum(axis=1) / np.sqrt(rate)
    accel += noise * ACCEL_SIGMA * rng.standard_normal((n, 3))
    accel += bias * (ACCEL_WALK * walks[0] + rng.normal(0.0, ACCEL_BIAS, 3))
    gyro += noise * GYRO_SIGMA * rng.standard_normal((n, 3))
    gyro += bias * (GYRO_WALK * walks[1] + rng.normal(0.0, GYRO_BIAS, 3))
    degree = np.pi / 180.0
    tilt = np.stack([draw_field(rng, s * degree, 20.0).along(time) for s in (0.2, 0.2, 1.0)], axis=-1)
    tilt[:, 2] += rng.uniform(-15.0, 15.0) * degree
    return Inertial(time, accel, gyro, (Rotation.from_rotvec(noise * tilt) * r_here).as_quat())


def measure_prism(
    rng: np.random.Generator, walk: Walk, sigma: float
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Return times, s, and positions, m, of the prism as a tracking total station reports them.

    About 3 Hz, not quite evenly, with noise of `sigma`, m, in each axis; one row in forty has changed places with the
    next.
    """
    n = int(walk.duration * PRISM_RATE)
    time = (np.arange(n) + rng.uniform(0.35, 0.65, n)) / PRISM_RATE
    poses = walk.poses(time)
    position = poses.position + Rotation.from_quat(poses.quaternion).apply(PRISM.origin)
    position += sigma * rng.standard_normal((n, 3))
    order = np.arange(n)
    for i in rng.choice(n - 1, max(2, n // 40), replace=False):
        order[[i, i + 1]] = order[[i + 1, i]]
    return time[order], position[order]
