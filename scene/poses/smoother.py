"""What was measured, brought onto one chain of knots: with an IMU, or with odometry in its place."""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_smoothing_spline

from scene.errors import FitError
from scene.poses import headings
from scene.poses import rotation as so3
from scene.poses.calibration import Mount
from scene.poses.chain import Chain, Motion
from scene.poses.control import Control
from scene.poses.imu import Inertial
from scene.poses.odometry import Odometry
from scene.poses.problem import SMOOTH_BETWEEN_SWEEPS, Noise, Problem
from scene.poses.terms import Sightings, Steps

_KNOT_STEP = 0.025  # s; between two knots a walker's motion is straight to 0.2 mm and 0.005°
# What one step of the odometry is trusted to: rad, and m across and along the bore. Measured on simulated surveys.
_STEP_TURN, _STEP_ACROSS, _STEP_ALONG = np.deg2rad(0.1), 0.02, 1.0
_FREE_TURN, _FREE_SPEED = 3.0, 1.0  # rad/√s and m/s/√s: how fast a carrier may change its mind, nothing measured
# The same where an IMU guides the odometry: between every fourth knot, 0.1 s, a sweep.
_IMU_STEP_KNOTS = 4
_IMU_STEP_TURN, _IMU_STEP_ACROSS, _IMU_STEP_ALONG = np.deg2rad(0.03), 0.01, 1.0


def inertial_problem(
    inertial: Inertial, control: Control, lever: Float[np.ndarray, "3"], noise: Noise
) -> tuple[Problem, Chain]:
    """The problem of an IMU that carries a prism, and a first guess with its x axis in the direction of motion.

    Args:
        inertial: The IMU; the body's axes are its own.
        control: Where the prism was.
        lever: Of the prism in the IMU's axes, m.
        noise: See `Noise`.
    """
    start = max(inertial.times[0], control.times[0])
    end = min(inertial.times[-1], control.times[-1])
    times = np.linspace(start, end, max(int((end - start) / _KNOT_STEP), 2) + 1)
    spacing = float(np.median(np.diff(inertial.times)))
    rate, force = (means_between(times, inertial.times, values) for values in (inertial.rate, inertial.force))
    scale = np.sqrt(spacing)
    motion = Motion(rate, force, noise.gyro * scale, noise.accel * scale, True)
    position, velocity = smoothed(control, times)
    attitude = headings.levelled(times, np.vstack([rate, rate[-1:]]), np.vstack([force, force[-1:]]))
    zero = np.zeros((len(times), 3))
    chain = Chain(times, attitude, position - attitude @ lever, velocity, zero, zero)
    return Problem(motion, sightings(control, times, lever, noise.control), None, noise), chain


def odometry_problem(
    odometry: Odometry, control: Control, lever: Float[np.ndarray, "3"], noise: Noise
) -> tuple[Problem, Chain]:
    """The problem of a LiDAR that carries a prism: attitude and cross-axis shifts from odometry, the rest from control.

    Args:
        odometry: One pose a sweep; these are the knots.
        control: Where the prism was.
        lever: Of the prism in LiDAR coordinates, m.
        noise: See `Noise`.

    Raises:
        FitError: The sweeps and the control share fewer than three of the sweeps' times.
    """
    poses = odometry.trajectory
    shared = np.flatnonzero((poses.times >= control.times[0]) & (poses.times <= control.times[-1]))
    if len(shared) < 3:
        raise FitError(f"{control.path}: only {len(shared)} sweeps lie within the control's time")
    times, turns = poses.times[shared], poses.rotations[shared].as_matrix()
    back = so3.inverse(turns[:-1])
    shift = so3.apply(back, np.diff(poses.positions[shared], axis=0))
    along = odometry.weakest[shared[1:], :, None] * odometry.weakest[shared[1:], None, :]
    n = np.arange(len(times) - 1)
    turn_root = np.broadcast_to(np.eye(3) / _STEP_TURN, along.shape)
    shift_root = (np.eye(3) - along) / _STEP_ACROSS + along / _STEP_ALONG
    steps = Steps(n, n + 1, back @ turns[1:], shift, turn_root, shift_root)
    zero = np.zeros((len(times), 3))
    free = Motion(zero[1:], zero[1:], _FREE_TURN, _FREE_SPEED, False)
    position, velocity = smoothed(control, times)
    chain = Chain(times, turns, position - turns @ lever, velocity, zero, zero)
    seen = sightings(control, times, lever, np.hypot(noise.control, SMOOTH_BETWEEN_SWEEPS))
    return Problem(free, seen, steps, noise, inertial=False), chain


def steps_of_imu(odometry: Odometry, chain: Chain, mount: Mount) -> Steps:
    """The odometry between every fourth knot, as steps of the IMU."""
    poses = odometry.trajectory
    knots = np.arange(0, len(chain.times), _IMU_STEP_KNOTS)
    knots = knots[(chain.times[knots] >= poses.times[0]) & (chain.times[knots] <= poses.times[-1])]
    places, turns = poses.at(chain.times[knots])
    attitude = turns.as_matrix() @ mount.rotation.T
    places = places + turns.apply(mount.origin)
    back = so3.inverse(attitude[:-1])
    nearest = np.clip(np.searchsorted(poses.times, chain.times[knots[1:]]), 0, len(poses.times) - 1)
    weakest = odometry.weakest[nearest] @ mount.rotation.T
    along = weakest[:, :, None] * weakest[:, None, :]
    return Steps(
        knots[:-1],
        knots[1:],
        back @ attitude[1:],
        so3.apply(back, np.diff(places, axis=0)),
        np.broadcast_to(np.eye(3) / _IMU_STEP_TURN, along.shape),
        (np.eye(3) - along) / _IMU_STEP_ACROSS + along / _IMU_STEP_ALONG,
    )


def means_between(
    knots: Float[np.ndarray, " n"], times: Float[np.ndarray, " m"], values: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "k 3"]:
    """Mean of sampled values over each interval between knots, by the trapezium rule."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(times)[:, None]
    total = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    at = np.stack([np.interp(knots, times, column) for column in total.T], axis=1)
    return np.diff(at, axis=0) / np.diff(knots)[:, None]


def smoothed(control: Control, times: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Position (m) and velocity (m/s) of the prism at any time by a smoothing spline; straight on beyond its ends."""
    origin = control.positions[0]
    splines = [
        make_smoothing_spline(control.times - control.times[0], column, lam=1e-3)
        for column in (control.positions - origin).T
    ]
    since = np.clip(times, control.times[0], control.times[-1]) - control.times[0]
    position = np.stack([spline(since) for spline in splines], axis=1) + origin
    return position, np.stack([spline.derivative()(since) for spline in splines], axis=1)


def sightings(
    control: Control, times: Float[np.ndarray, " n"], lever: Float[np.ndarray, "3"], sigma: float
) -> Sightings:
    """The control rows that lie between knots.

    Raises:
        FitError: None does.
    """
    inside = (control.times >= times[0]) & (control.times <= times[-1])
    if not inside.any():
        raise FitError(f"{control.path}: no row of the control lies within the recording")
    when = control.times[inside]
    knot = np.clip(np.searchsorted(times, when, "right") - 1, 0, len(times) - 2)
    share = (when - times[knot]) / (times[knot + 1] - times[knot])
    return Sightings(knot, share, control.positions[inside], lever, sigma)
