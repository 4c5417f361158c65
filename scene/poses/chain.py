"""The unknowns of a smoothed trajectory, and what an IMU says of neighbouring ones.

Residuals and derivatives are written out for a turn of the attitude on the body's side, `R Exp(turn)`.
Source: Forster et al., On-Manifold Preintegration for Real-Time Visual-Inertial Odometry, 2017.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scene.poses import rotation as so3
from scene.poses.imu import GRAVITY
from scene.poses.leastsquares import NormalEquations

SIZE = 15
TURN, PLACE, _SPEED, _GYRO, _ACCEL = (slice(3 * k, 3 * k + 3) for k in range(5))
_EYE = np.eye(3)


@dataclass(frozen=True)
class Chain:
    """Knots in time, and the state of the body at each.

    Attributes:
        times: s, `(n,)`.
        attitude: Body to fixed frame, `(n, 3, 3)`.
        position: Of the body's origin, m, `(n, 3)`.
        velocity: m/s, `(n, 3)`.
        gyro_bias: rad/s, `(n, 3)`.
        accel_bias: m/s², `(n, 3)`.
    """

    times: Float[np.ndarray, " n"]
    attitude: Float[np.ndarray, "n 3 3"]
    position: Float[np.ndarray, "n 3"]
    velocity: Float[np.ndarray, "n 3"]
    gyro_bias: Float[np.ndarray, "n 3"]
    accel_bias: Float[np.ndarray, "n 3"]

    def moved(self, step: Float[np.ndarray, "n 15"]) -> "Chain":
        """The chain after a step of the solver."""
        return Chain(
            self.times,
            self.attitude @ so3.exp(step[:, TURN]),
            self.position + step[:, PLACE],
            self.velocity + step[:, _SPEED],
            self.gyro_bias + step[:, _GYRO],
            self.accel_bias + step[:, _ACCEL],
        )


@dataclass(frozen=True)
class Motion:
    """Mean rate and force between neighbouring knots.

    Attributes:
        rate: rad/s, `(n - 1, 3)`.
        force: m/s², `(n - 1, 3)`; zero where nothing measured it.
        rate_sigma: Of the change of attitude, rad/√s.
        force_sigma: Of the change of velocity, m/s/√s.
        has_force: Whether `force` was measured; otherwise the velocity is merely slow to change.
    """

    rate: Float[np.ndarray, "k 3"]
    force: Float[np.ndarray, "k 3"]
    rate_sigma: float
    force_sigma: float
    has_force: bool


def add_motion(equations: NormalEquations, chain: Chain, motion: Motion, smooth: float) -> None:
    """Adds what rates and forces say of neighbouring knots.

    Args:
        equations: Added to.
        chain: Where to linearise.
        motion: The measurements.
        smooth: Standard deviation of a position against the mean of two velocities, m.
    """
    here, after = np.arange(len(chain.times) - 1), np.arange(1, len(chain.times))
    span = np.diff(chain.times)[:, None]
    turn = (motion.rate - chain.gyro_bias[here]) * span
    before, later = chain.attitude[here], chain.attitude[after]
    twist = so3.log(so3.inverse(so3.exp(turn)) @ so3.inverse(before) @ later)
    n = len(here)
    first, second, residual = np.zeros((n, 9, SIZE)), np.zeros((n, 9, SIZE)), np.zeros((n, 9))
    near = _EYE + 0.5 * so3.skew(twist)
    residual[:, :3] = twist
    first[:, :3, TURN] = -near @ so3.inverse(later) @ before
    first[:, :3, _GYRO] = _EYE * span[:, :, None]
    second[:, :3, TURN] = near
    residual[:, 3:6] = chain.velocity[after] - chain.velocity[here]
    if motion.has_force:
        half = so3.exp(0.5 * turn)
        middle = before @ half
        force = motion.force - chain.accel_bias[here]
        residual[:, 3:6] -= (so3.apply(middle, force) - (0.0, 0.0, GRAVITY)) * span
        first[:, 3:6, TURN] = span[:, :, None] * (middle @ so3.skew(force) @ so3.inverse(half))
        first[:, 3:6, _GYRO] = -0.5 * span[:, :, None] ** 2 * (middle @ so3.skew(force))
        first[:, 3:6, _ACCEL] = span[:, :, None] * middle
    first[:, 3:6, _SPEED], second[:, 3:6, _SPEED] = -_EYE, _EYE
    residual[:, 6:] = chain.position[after] - chain.position[here]
    residual[:, 6:] -= 0.5 * span * (chain.velocity[after] + chain.velocity[here])
    first[:, 6:, PLACE], second[:, 6:, PLACE] = -_EYE, _EYE
    first[:, 6:, _SPEED] = second[:, 6:, _SPEED] = -0.5 * span[:, :, None] * _EYE
    root = np.sqrt(span)
    scale = np.repeat(
        np.hstack([motion.rate_sigma * root, motion.force_sigma * root, np.full_like(root, smooth)]), 3, 1
    )
    equations.add(residual / scale, here, first / scale[:, :, None], after, second / scale[:, :, None])


def add_biases(equations: NormalEquations, chain: Chain, prior: tuple[float, float], walk: tuple[float, float]) -> None:
    """Adds that biases of gyro (rad/s) and accelerometer (m/s²) start near zero and change slowly (per √s)."""
    bias = np.hstack([chain.gyro_bias, chain.accel_bias])
    unit = np.zeros((1, 6, SIZE))
    unit[:, :3, _GYRO], unit[:, 3:, _ACCEL] = _EYE, _EYE
    start = np.repeat(prior, 3)
    equations.add(bias[:1] / start, np.zeros(1, np.intp), unit / start[:, None])
    scale = np.repeat(np.sqrt(np.diff(chain.times))[:, None] * np.asarray(walk), 3, axis=1)
    weighted = unit / scale[:, :, None]
    here = np.arange(len(bias) - 1)
    equations.add(np.diff(bias, axis=0) / scale, here, -weighted, here + 1, weighted)
