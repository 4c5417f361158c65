"""Least squares over a chain of knots in time: the unknowns, and one term for each kind of measurement.

Terms join knots that are near in time, so the normal matrix is a band. A banded Cholesky factorisation is linear in the
number of knots and has one order of operations: the same input gives the same bytes, which general sparse or threaded
solvers do not promise. Residuals and derivatives are written out for a turn of the attitude on the body's side,
`R Exp(turn)`.

Source: Forster et al., On-Manifold Preintegration for Real-Time Visual-Inertial Odometry, 2017.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, solveh_banded
from scipy.spatial.transform import Rotation

from scene.errors import FitError, Refusal
from scene.poses.imu import GRAVITY

Vectors = Float[np.ndarray, "n 3"]
Matrices = Float[np.ndarray, "n 3 3"]


def rotation_matrices(vector: Vectors) -> Matrices:
    """Return the matrices of rotation vectors, rad."""
    return Rotation.from_rotvec(vector).as_matrix()


def rotation_vectors(matrix: Matrices) -> Vectors:
    """Return the rotation vectors of matrices, rad, of length at most π."""
    return Rotation.from_matrix(matrix).as_rotvec()


def cross_matrices(vector: Vectors) -> Matrices:
    """Return the matrices that take the cross product with each vector from the left."""
    x, y, z = vector.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def rotate_vectors(matrix: Matrices, vector: Vectors) -> Vectors:
    """Turns each vector by its matrix."""
    return np.einsum("nij,nj->ni", matrix, vector)


class NormalEquations:
    """The normal equations of least squares over `n` knots of `size` unknowns each.

    Attributes:
        size: Unknowns a knot.
        reach: Largest distance in knots between two that one term joins.
    """

    def __init__(self, n: int, size: int, reach: int) -> None:
        self.size, self.reach = size, reach
        # By the distance between two knots and the earlier one; of a knot with itself the lower half counts.
        self._blocks = np.zeros((reach + 1, n, size, size))
        self._right = np.zeros(n * size)
        self.cost = 0.0

    def add(
        self,
        residual: Float[np.ndarray, "m r"],
        first: Int[np.ndarray, " m"],
        jacobian_first: Float[np.ndarray, "m r s"],
        second: Int[np.ndarray, " m"] | None = None,
        jacobian_second: Float[np.ndarray, "m r s"] | None = None,
    ) -> None:
        """Adds residuals, in standard deviations, with the knot of each and the derivative by that knot's unknowns.

        A term that joins two knots has a later, second one.
        """
        self.cost += float(np.sum(residual**2))
        self._block(first, first, jacobian_first, jacobian_first)
        self._gradient(first, jacobian_first, residual)
        if second is not None and jacobian_second is not None:
            self._block(second, second, jacobian_second, jacobian_second)
            self._block(second, first, jacobian_second, jacobian_first)
            self._gradient(second, jacobian_second, residual)

    def _block(self, row: np.ndarray, column: np.ndarray, left: np.ndarray, right: np.ndarray) -> None:
        block, place = np.einsum("mra,mrb->mab", left, right), (row - column) * self._blocks.shape[1] + column
        once, where = np.unique(place, return_inverse=True)
        if len(once) < len(place):
            terms, block, place = block, np.zeros((len(once), self.size, self.size)), once
            np.add.at(block, where, terms)
        self._blocks.reshape(-1, self.size, self.size)[place] += block

    def _lower_band(self) -> np.ndarray:
        """Return the matrix in scipy's lower form: entry (row, column) lies at [row - column, column]."""
        reach, n, size = self._blocks.shape[:3]
        rows = self._blocks.transpose(0, 2, 1, 3).reshape(reach * size, n, size)
        band = np.zeros_like(rows)
        for k in range(size):
            band[: len(rows) - k, :, k] = rows[k:, :, k]
        return band.reshape(len(rows), n * size)

    def _gradient(self, knot: np.ndarray, jacobian: np.ndarray, residual: np.ndarray) -> None:
        place = self.size * knot[:, None] + np.arange(self.size)
        value = np.einsum("mrs,mr->ms", jacobian, residual)
        self._right -= np.bincount(place.ravel(), value.ravel(), len(self._right))

    def solve(self, damping: float = 0.0) -> Float[np.ndarray, "n s"]:
        """Return the step that lowers the cost; raises `FitError` where some unknown is not determined.

        `damping` is the fraction of the diagonal added to it (Levenberg-Marquardt).
        """
        band = self._lower_band()
        band[0] *= 1.0 + damping
        try:
            return solveh_banded(band, self._right, lower=True, overwrite_ab=True).reshape(-1, self.size)
        except LinAlgError as error:
            why = f"the trajectory is not determined by what was measured ({error})"
            raise FitError(why, Refusal.POSES) from error


KNOT_SIZE = 15  # unknowns of a state: attitude, position, velocity, two biases
_TURN, _SHIFT, _SPEED, _GYRO, _ACCEL = (slice(3 * k, 3 * k + 3) for k in range(5))
_EYE = np.eye(3)


@dataclass(frozen=True)
class Chain:
    """Knots in time, and the state of the body at each."""

    times: Float[np.ndarray, " n"]  # s
    attitude: Float[np.ndarray, "n 3 3"]  # Body to fixed frame
    position: Float[np.ndarray, "n 3"]  # Position of the body's origin, m
    velocity: Float[np.ndarray, "n 3"]  # m/s
    gyro_bias: Float[np.ndarray, "n 3"]  # rad/s
    accel_bias: Float[np.ndarray, "n 3"]  # m/s²

    def after(self, step: Float[np.ndarray, "n 15"]) -> "Chain":
        """Return the chain after a step of the solver."""
        return Chain(
            self.times,
            self.attitude @ rotation_matrices(step[:, _TURN]),
            self.position + step[:, _SHIFT],
            self.velocity + step[:, _SPEED],
            self.gyro_bias + step[:, _GYRO],
            self.accel_bias + step[:, _ACCEL],
        )


@dataclass(frozen=True)
class Motion:
    """Mean rate and force between neighbouring knots."""

    rate: Float[np.ndarray, "k 3"]  # rad/s
    force: Float[np.ndarray, "k 3"]  # m/s²
    rate_sigma: float  # Standard deviation of the change of attitude, rad/√s
    force_sigma: float  # Standard deviation of the change of velocity, m/s/√s


def add_motion(equations: NormalEquations, chain: Chain, motion: Motion, smooth: float) -> None:
    """Adds rates and forces between neighbouring knots, linearised at `chain`.

    `smooth` is the standard deviation of a position against the mean of two velocities, m.
    """
    here, after = np.arange(len(chain.times) - 1), np.arange(1, len(chain.times))
    span = np.diff(chain.times)[:, None]
    turn = (motion.rate - chain.gyro_bias[here]) * span
    before, later = chain.attitude[here], chain.attitude[after]
    twist = rotation_vectors(rotation_matrices(turn).mT @ before.mT @ later)
    n = len(here)
    first, second, residual = np.zeros((n, 9, KNOT_SIZE)), np.zeros((n, 9, KNOT_SIZE)), np.zeros((n, 9))
    near = _EYE + 0.5 * cross_matrices(twist)
    residual[:, :3] = twist
    first[:, :3, _TURN] = -near @ later.mT @ before
    first[:, :3, _GYRO] = _EYE * span[:, :, None]
    second[:, :3, _TURN] = near
    residual[:, 3:6] = chain.velocity[after] - chain.velocity[here]
    half = rotation_matrices(0.5 * turn)
    middle = before @ half
    force = motion.force - chain.accel_bias[here]
    residual[:, 3:6] -= (rotate_vectors(middle, force) - (0.0, 0.0, GRAVITY)) * span
    first[:, 3:6, _TURN] = span[:, :, None] * (middle @ cross_matrices(force) @ half.mT)
    first[:, 3:6, _GYRO] = -0.5 * span[:, :, None] ** 2 * (middle @ cross_matrices(force))
    first[:, 3:6, _ACCEL] = span[:, :, None] * middle
    first[:, 3:6, _SPEED], second[:, 3:6, _SPEED] = -_EYE, _EYE
    residual[:, 6:] = chain.position[after] - chain.position[here]
    residual[:, 6:] -= 0.5 * span * (chain.velocity[after] + chain.velocity[here])
    first[:, 6:, _SHIFT], second[:, 6:, _SHIFT] = -_EYE, _EYE
    first[:, 6:, _SPEED] = second[:, 6:, _SPEED] = -0.5 * span[:, :, None] * _EYE
    root = np.sqrt(span)
    scale = np.repeat(
        np.hstack([motion.rate_sigma * root, motion.force_sigma * root, np.full_like(root, smooth)]), 3, 1
    )
    equations.add(residual / scale, here, first / scale[:, :, None], after, second / scale[:, :, None])


def add_biases(equations: NormalEquations, chain: Chain, prior: tuple[float, float], walk: tuple[float, float]) -> None:
    """Adds that biases of gyro (rad/s) and accelerometer (m/s²) start near zero and change slowly (per √s)."""
    bias = np.hstack([chain.gyro_bias, chain.accel_bias])
    unit = np.zeros((1, 6, KNOT_SIZE))
    unit[:, :3, _GYRO], unit[:, 3:, _ACCEL] = _EYE, _EYE
    start = np.repeat(prior, 3)
    equations.add(bias[:1] / start, np.zeros(1, np.intp), unit / start[:, None])
    scale = np.repeat(np.sqrt(np.diff(chain.times))[:, None] * np.asarray(walk), 3, axis=1)
    weighted = unit / scale[:, :, None]
    here = np.arange(len(bias) - 1)
    equations.add(np.diff(bias, axis=0) / scale, here, -weighted, here + 1, weighted)


@dataclass(frozen=True)
class Sightings:
    """Positions of a point fixed to the body."""

    knot: Int[np.ndarray, " m"]  # Knot before each
    fraction: Float[np.ndarray, " m"]  # Way from that knot to the next, 0 to 1
    position: Float[np.ndarray, "m 3"]  # m
    lever: Float[np.ndarray, "3"]  # Position of the point in the body, m
    sigma: float  # Standard deviation in each axis, m

    def residual(self, chain: Chain) -> Float[np.ndarray, "m 3"]:
        """Return estimated less measured position of the point, m."""
        position, attitude, _ = self._between(chain)
        return position + attitude @ self.lever - self.position

    def _between(self, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        fraction, after = self.fraction[:, None], self.knot + 1
        position = (1 - fraction) * chain.position[self.knot] + fraction * chain.position[after]
        turn = rotation_vectors(chain.attitude[self.knot].mT @ chain.attitude[after])
        return position, chain.attitude[self.knot] @ rotation_matrices(fraction * turn), fraction[:, :, None]

    def add_to(self, equations: NormalEquations, chain: Chain, robust: float) -> None:
        """Adds these terms; beyond `robust` standard deviations (Cauchy) a sighting counts ever less."""
        position, attitude, fraction = self._between(chain)
        residual = (position + attitude @ self.lever - self.position) / self.sigma
        weight = 1 / np.sqrt(1 + (np.linalg.norm(residual, axis=1) / robust) ** 2)
        arm = -attitude @ cross_matrices(self.lever[None])[0]
        whole = np.zeros((len(residual), 3, KNOT_SIZE))
        whole[:, :, _TURN], whole[:, :, _SHIFT] = arm, _EYE
        whole *= (weight / self.sigma)[:, None, None]
        equations.add(weight[:, None] * residual, self.knot, (1 - fraction) * whole, self.knot + 1, fraction * whole)


@dataclass(frozen=True)
class Steps:
    """Relative poses between knots, from LiDAR odometry."""

    first: Int[np.ndarray, " m"]  # Earlier knot of each
    second: Int[np.ndarray, " m"]  # Later knot of each
    turn: Float[np.ndarray, "m 3 3"]  # Attitude of the second in the first
    shift: Float[np.ndarray, "m 3"]  # Position of the second in the first, m
    turn_root: Float[np.ndarray, "m 3 3"]  # Square root of the information matrix of the turn, 1/rad
    shift_root: Float[np.ndarray, "m 3 3"]  # Square root of the information matrix of the shift, 1/m

    def add_to(self, equations: NormalEquations, chain: Chain, robust: float) -> None:
        """Adds these terms; beyond `robust` standard deviations (Cauchy) a step counts ever less."""
        before, after = chain.attitude[self.first], chain.attitude[self.second]
        back = before.mT
        twist = rotation_vectors(self.turn.mT @ back @ after)
        way = rotate_vectors(back, chain.position[self.second] - chain.position[self.first])
        near = _EYE + 0.5 * cross_matrices(twist)
        n = len(self.first)
        residual = np.zeros((n, 6))
        first, second = np.zeros((n, 6, KNOT_SIZE)), np.zeros((n, 6, KNOT_SIZE))
        residual[:, :3] = rotate_vectors(self.turn_root, twist)
        residual[:, 3:] = rotate_vectors(self.shift_root, way - self.shift)
        first[:, :3, _TURN] = -self.turn_root @ near @ after.mT @ before
        second[:, :3, _TURN] = self.turn_root @ near
        first[:, 3:, _TURN] = self.shift_root @ cross_matrices(way)
        first[:, 3:, _SHIFT] = -self.shift_root @ back
        second[:, 3:, _SHIFT] = self.shift_root @ back
        for half in (slice(0, 3), slice(3, 6)):
            weight = 1 / np.sqrt(1 + (np.linalg.norm(residual[:, half], axis=1) / robust) ** 2)
            residual[:, half] *= weight[:, None]
            first[:, half] *= weight[:, None, None]
            second[:, half] *= weight[:, None, None]
        equations.add(residual, self.first, first, self.second, second)
