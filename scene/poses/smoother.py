"""The trajectory of least cost: IMU, odometry and control, on one chain of knots."""

from dataclasses import astuple, dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import gaussian_filter1d

from scene.errors import FitError, Refusal
from scene.poses import terms
from scene.poses.calibration import Mount
from scene.poses.imu import Inertial, integrals
from scene.poses.odometry import Odometry
from scene.poses.terms import Chain, Motion, Sightings, Steps
from scene.poses.trajectory import MIN_CONTROL_ROWS, Control

_YAWS = np.deg2rad(np.arange(0, 360, 45))
_TRIAL = 60.0  # s of the recording on which the mounting's heading is tried out
_TRIAL_ITERATIONS, _ITERATIONS = 8, 25  # Gauss-Newton steps, of a guess of the heading and of the solution
_CONVERGED = 1e-6  # rad and m
_BIAS = (0.02, 0.3)  # rad/s, m/s²: biases that a MEMS gyro and accelerometer may start with
# Standard deviation of a position against the mean of two velocities, m: jerk · step³ / 12 of a walker's stride.
_SMOOTH = 2e-4


@dataclass(frozen=True)
class Noise:
    """Standard deviations that the instruments are trusted to."""

    control: float = 0.003  # Standard deviation of a control position in each axis, m
    gyro: float = 5.144e-3  # Standard deviation of one rate, rad/s. Source: GEODE, device γ
    # Standard deviation of one force, m/s²; the published figure times 3, for scale and alignment errors
    accel: float = 3 * 5.574e-3
    gyro_walk: float = 1.088e-4  # Random walk of the gyro's bias, rad/s/√s
    accel_walk: float = 1.208e-4  # Random walk of the accelerometer's bias, m/s²/√s
    robust: float = 4.0  # Number of standard deviations beyond which a measurement counts ever less


@dataclass(frozen=True)
class Problem:
    """Everything that was measured, on one chain of knots."""

    motion: Motion  # Rates and forces between knots
    sightings: Sightings  # Sightings of the prism
    steps: Steps | None  # Steps of the odometry, where it ran
    noise: Noise  # Standard deviations of the instruments

    def solve(self, chain: Chain, iterations: int = _ITERATIONS) -> tuple[Chain, float]:
        """Return the chain of least cost near `chain`, and that cost."""
        damping, cost = 1e-6, np.inf
        best = chain
        for _ in range(iterations):
            equations = self._equations(chain)
            if equations.cost < cost:
                best, cost, damping = chain, equations.cost, max(damping / 10, 1e-9)
                step = equations.solve(damping)
                accepted = equations
            else:
                damping *= 100
                step = accepted.solve(damping)
            chain = best.after(step)
            if np.abs(step[:, :6]).max() < _CONVERGED:
                break
        return best, cost

    def _equations(self, chain: Chain) -> terms.NormalEquations:
        reach = 1 if self.steps is None else int((self.steps.second - self.steps.first).max())
        equations = terms.NormalEquations(len(chain.times), terms.KNOT_SIZE, reach)
        noise = self.noise
        terms.add_motion(equations, chain, self.motion, _SMOOTH)
        terms.add_biases(equations, chain, _BIAS, (noise.gyro_walk, noise.accel_walk))
        self.sightings.add_to(equations, chain, noise.robust)
        if self.steps is not None:
            self.steps.add_to(equations, chain, noise.robust)
        return equations


def solve_with_heading(problem: Problem, chain: Chain) -> Chain:
    """Solves from every mounting of the body about the vertical on the first minute, then the whole from the best."""
    n = min(len(chain.times), int(np.searchsorted(chain.times, chain.times[0] + _TRIAL)) + 1)
    short, piece = _first_knots(problem, chain, n)
    trials = [short.solve(_turn_chain(piece, short.sightings.lever, yaw), _TRIAL_ITERATIONS)[1] for yaw in _YAWS]
    guess = _turn_chain(chain, problem.sightings.lever, float(_YAWS[int(np.argmin(trials))]))
    return problem.solve(guess)[0]


def _turn_chain(chain: Chain, lever: np.ndarray, yaw: float) -> Chain:
    attitude = turn_along_track(chain.times, chain.attitude, chain.velocity, yaw)
    prism = chain.position + chain.attitude @ lever
    return replace(chain, attitude=attitude, position=prism - attitude @ lever)


def _first_knots(problem: Problem, chain: Chain, n: int) -> tuple[Problem, Chain]:
    """Return the first `n` knots and what IMU and control measured between them."""
    motion, short = _part_of(problem.motion, chain, slice(0, n))
    seen = problem.sightings
    near = seen.knot < n - 1
    seen = replace(seen, knot=seen.knot[near], fraction=seen.fraction[near], position=seen.position[near])
    return replace(problem, motion=motion, sightings=seen), short


def _part_of(motion: Motion, chain: Chain, part: slice) -> tuple[Motion, Chain]:
    """Return some knots, and what an IMU measured between them."""
    short = Chain(*(values[part] for values in astuple(chain)))
    between = slice(part.start, part.start + len(short.times) - 1)
    return replace(motion, rate=motion.rate[between], force=motion.force[between]), short


_LAG_TIME = 20.0  # s of the recording, about its middle, by which the lag of a control is found
_LAG_STEP, _FARTHEST = 0.05, 1.5  # s: between lags that are tried, and the largest
_LAG_ITERATIONS = 6  # Gauss-Newton steps for each
_REFINED = (0.03, 0.02, 0.01, 0.01)  # s; between lags about the best of these
_TELLS = 18.0  # least bend of the cost about it over the last of these, by which it is known to 3 ms
_FITS = 2.0  # largest cost of a coordinate of a sighting that fits the motion


def find_control_lag(problem: Problem, chain: Chain, control: Control) -> float | None:
    """Return how much later the clock of a control is than the IMU's, s: then their motions fit best.

    `chain` is the solution with the control as it is. `None` where the motion does not tell.
    """
    middle, half = len(chain.times) // 2, round(0.5 * _LAG_TIME / _KNOT_STEP)
    motion, short = _part_of(problem.motion, chain, slice(max(middle - half, 0), middle + half + 1))
    inside = np.abs(control.times - short.times[[0, -1]].mean()) < 0.5 * np.ptp(short.times) - _FARTHEST - 2 * _LAG_STEP
    rows = replace(control, times=control.times[inside], positions=control.positions[inside])
    if len(rows.times) < MIN_CONTROL_ROWS:
        return None

    def solve(lag: float, chain: Chain, iterations: int = _LAG_ITERATIONS) -> tuple[Chain, float]:
        late = replace(rows, times=rows.times - lag)
        seen = make_sightings(late, chain.times, problem.sightings.lever, problem.sightings.sigma)
        return Problem(motion, seen, None, problem.noise).solve(chain, iterations)

    most, costs = _FITS * rows.positions.size, dict[float, float]()
    for lag in sorted(np.arange(-_FARTHEST, _FARTHEST + 1e-9, _LAG_STEP), key=abs):
        costs[lag] = solve(lag, short)[1]
        if costs[lag] < most:
            break
    best = min(costs, key=lambda lag: costs[lag])
    for step in _REFINED:  # parabolas through three lags, about a solution that remembers no other lag
        short, here = solve(best, short, _ITERATIONS)
        before, after = (solve(best + side, short, _ITERATIONS)[1] for side in (-step, step))
        bend = before - 2.0 * here + after
        within = here <= min(before, after) and bend > _TELLS
        best += float(0.5 * step * (before - after) / bend if within else step * np.sign(before - after))
    return float(best) if here < most and within else None


_KNOT_STEP = 0.025  # s; between two knots a walker's motion is straight to 0.2 mm and 0.005°
# Standard deviation of a step of the odometry over one sweep, four knots, 0.1 s: rad, m across and m along the bore.
# Measured on simulated surveys.
_IMU_STEP_KNOTS = 4
_IMU_STEP = (np.deg2rad(0.03), 0.01, 1.0)
_LEVEL_TIME = 1.0  # s; over this a walker's accelerations cancel
_TRACK_TIME = 10.0  # s; over this the carrier faces, on average, the way it goes


def level_attitudes(
    times: Float[np.ndarray, " n"], rate: Float[np.ndarray, "n 3"], force: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """Return attitudes with roll and pitch from gravity and heading from the gyro, from zero.

    Times are even, s; rates in rad/s; forces in any unit.
    """
    step = float(np.median(np.diff(times)))
    up = gaussian_filter1d(force, _LEVEL_TIME / step, axis=0, mode="nearest")
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    heading = np.concatenate([[0.0], np.cumsum(np.einsum("ij,ij->i", rate, up)[:-1] * np.diff(times))])
    # The smallest turn from `up` to the vertical.
    axis = np.cross(up, [0.0, 0.0, 1.0])
    size = np.linalg.norm(axis, axis=1, keepdims=True)
    level = terms.rotation_matrices(axis / np.maximum(size, 1e-9) * np.arctan2(size[:, 0], up[:, 2])[:, None])
    return _rotations_about_z(heading) @ level


def turn_along_track(
    times: Float[np.ndarray, " n"], attitude: Float[np.ndarray, "n 3 3"], velocity: Float[np.ndarray, "n 3"], yaw: float
) -> Float[np.ndarray, "n 3 3"]:
    """Turns attitudes slowly about the vertical until their x axis keeps `yaw` rad left of the motion.

    Times are even, s. The velocity in the fixed frame, m/s, weighs by its size.
    """
    step = float(np.median(np.diff(times)))
    facing = np.arctan2(attitude[:, 1, 0], attitude[:, 0, 0])
    pointer = (velocity[:, 0] + 1j * velocity[:, 1]) * np.exp(1j * (yaw - facing))
    width = min(_TRACK_TIME, 0.25 * (times[-1] - times[0])) / step
    smooth = gaussian_filter1d(pointer.real, width, mode="nearest") + 1j * gaussian_filter1d(
        pointer.imag, width, mode="nearest"
    )
    return _rotations_about_z(np.angle(smooth)) @ attitude


def _rotations_about_z(angle: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 3"]:
    return terms.rotation_matrices(angle[:, None] * np.array([0.0, 0.0, 1.0]))


def inertial_problem(
    inertial: Inertial, control: Control, lever: Float[np.ndarray, "3"], noise: Noise
) -> tuple[Problem, Chain]:
    """Return the problem of an IMU with a prism, and a first guess whose x axis points along the motion.

    The body's axes are the IMU's, and `lever` is the prism in them, m.
    """
    start = max(inertial.times[0], control.times[0])
    end = min(inertial.times[-1], control.times[-1])
    times = np.linspace(start, end, max(int((end - start) / _KNOT_STEP), 2) + 1)
    spacing = float(np.median(np.diff(inertial.times)))
    rate, force = (means_between(times, inertial.times, values) for values in (inertial.rate, inertial.force))
    scale = np.sqrt(spacing)
    motion = Motion(rate, force, noise.gyro * scale, noise.accel * scale)
    position, velocity = smooth_control(control, times)
    attitude = level_attitudes(times, np.vstack([rate, rate[-1:]]), np.vstack([force, force[-1:]]))
    zero = np.zeros((len(times), 3))
    chain = Chain(times, attitude, position - attitude @ lever, velocity, zero, zero)
    return Problem(motion, make_sightings(control, times, lever, noise.control), None, noise), chain


def imu_steps(odometry: Odometry, chain: Chain, mount: Mount) -> Steps:
    """Return the odometry between every fourth knot, as steps of the IMU."""
    poses = odometry.trajectory
    knots = np.arange(0, len(chain.times), _IMU_STEP_KNOTS)
    knots = knots[(chain.times[knots] >= poses.times[0]) & (chain.times[knots] <= poses.times[-1])]
    places, turns = poses.at(chain.times[knots])
    attitude = turns.as_matrix() @ mount.rotation.T
    places = places + turns.apply(mount.origin)
    nearest = np.clip(np.searchsorted(poses.times, chain.times[knots[1:]]), 0, len(poses.times) - 1)
    return _make_steps(knots, attitude, places, odometry.weakest[nearest] @ mount.rotation.T, _IMU_STEP)


def _make_steps(
    knots: np.ndarray,
    attitude: np.ndarray,
    position: np.ndarray,
    weakest: np.ndarray,
    sigma: tuple[float, float, float],
) -> Steps:
    """Steps between neighbouring knots, trusted to `sigma`: rad, m across and m along the weakest direction."""
    back = attitude[:-1].mT
    shift = terms.rotate_vectors(back, np.diff(position, axis=0))
    along = weakest[:, :, None] * weakest[:, None, :]
    turn_root = np.broadcast_to(np.eye(3) / sigma[0], along.shape)
    shift_root = (np.eye(3) - along) / sigma[1] + along / sigma[2]
    return Steps(knots[:-1], knots[1:], back @ attitude[1:], shift, turn_root, shift_root)


def means_between(
    knots: Float[np.ndarray, " n"], times: Float[np.ndarray, " m"], values: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "k 3"]:
    """Return the mean of sampled values over each interval between knots, by the trapezium rule."""
    return np.diff(integrals(knots, times, values), axis=0) / np.diff(knots)[:, None]


def smooth_control(control: Control, times: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Return position (m) and velocity (m/s) of the prism by a smoothing spline; straight beyond its ends."""
    origin = control.positions[0]
    splines = [
        make_smoothing_spline(control.times - control.times[0], column, lam=1e-3)
        for column in (control.positions - origin).T
    ]
    since = np.clip(times, control.times[0], control.times[-1]) - control.times[0]
    position = np.stack([spline(since) for spline in splines], axis=1) + origin
    return position, np.stack([spline.derivative()(since) for spline in splines], axis=1)


def make_sightings(
    control: Control, times: Float[np.ndarray, " n"], lever: Float[np.ndarray, "3"], sigma: float
) -> Sightings:
    """Return the control rows that lie between knots; raises `FitError` where none does."""
    inside = (control.times >= times[0]) & (control.times <= times[-1])
    if not inside.any():
        raise FitError(f"{control.path}: no row of the control lies within the recording", Refusal.POSES)
    when = control.times[inside]
    knot = np.clip(np.searchsorted(times, when, "right") - 1, 0, len(times) - 2)
    fraction = (when - times[knot]) / (times[knot + 1] - times[knot])
    return Sightings(knot, fraction, control.positions[inside], lever, sigma)
