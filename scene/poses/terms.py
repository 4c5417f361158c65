"""What a total station and LiDAR odometry say of a smoothed trajectory, as terms of least squares."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from scene.poses import rotation as so3
from scene.poses.chain import PLACE, SIZE, TURN, Chain
from scene.poses.leastsquares import NormalEquations

_EYE = np.eye(3)


@dataclass(frozen=True)
class Sightings:
    """Positions of a point fixed to the body.

    Attributes:
        knot: Knot before each, `(m,)`.
        share: Way from that knot to the next, 0 to 1, `(m,)`.
        position: m, `(m, 3)`.
        lever: Of the point in the body, m, `(3,)`.
        sigma: Standard deviation in each axis, m.
    """

    knot: Int[np.ndarray, " m"]
    share: Float[np.ndarray, " m"]
    position: Float[np.ndarray, "m 3"]
    lever: Float[np.ndarray, "3"]
    sigma: float

    def residual(self, chain: Chain) -> Float[np.ndarray, "m 3"]:
        """Estimated less measured position of the point, m."""
        position, attitude, _ = self._between(chain)
        return position + attitude @ self.lever - self.position

    def _between(self, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        share, after = self.share[:, None], self.knot + 1
        position = (1 - share) * chain.position[self.knot] + share * chain.position[after]
        turn = so3.log(so3.inverse(chain.attitude[self.knot]) @ chain.attitude[after])
        return position, chain.attitude[self.knot] @ so3.exp(share * turn), share[:, :, None]

    def add_to(self, equations: NormalEquations, chain: Chain, robust: float) -> None:
        """Adds these terms; beyond `robust` standard deviations (Cauchy) a sighting counts ever less."""
        position, attitude, share = self._between(chain)
        residual = (position + attitude @ self.lever - self.position) / self.sigma
        weight = 1 / np.sqrt(1 + (np.linalg.norm(residual, axis=1) / robust) ** 2)
        arm = -attitude @ so3.skew(self.lever[None])[0]
        whole = np.zeros((len(residual), 3, SIZE))
        whole[:, :, TURN], whole[:, :, PLACE] = arm, _EYE
        whole *= (weight / self.sigma)[:, None, None]
        equations.add(weight[:, None] * residual, self.knot, (1 - share) * whole, self.knot + 1, share * whole)


@dataclass(frozen=True)
class Steps:
    """Relative poses between knots, from LiDAR odometry.

    Attributes:
        first, second: Knots joined, `(m,)`.
        turn: Attitude of the second in the first, `(m, 3, 3)`.
        shift: Position of the second in the first, m, `(m, 3)`.
        turn_root, shift_root: Square roots of the information matrices, `(m, 3, 3)`, 1/rad and 1/m.
    """

    first: Int[np.ndarray, " m"]
    second: Int[np.ndarray, " m"]
    turn: Float[np.ndarray, "m 3 3"]
    shift: Float[np.ndarray, "m 3"]
    turn_root: Float[np.ndarray, "m 3 3"]
    shift_root: Float[np.ndarray, "m 3 3"]

    def add_to(self, equations: NormalEquations, chain: Chain, robust: float) -> None:
        """Adds these terms; beyond `robust` standard deviations (Cauchy) a step counts ever less."""
        before, after = chain.attitude[self.first], chain.attitude[self.second]
        back = so3.inverse(before)
        twist = so3.log(so3.inverse(self.turn) @ back @ after)
        way = so3.apply(back, chain.position[self.second] - chain.position[self.first])
        near = _EYE + 0.5 * so3.skew(twist)
        n = len(self.first)
        residual = np.zeros((n, 6))
        first, second = np.zeros((n, 6, SIZE)), np.zeros((n, 6, SIZE))
        residual[:, :3] = so3.apply(self.turn_root, twist)
        residual[:, 3:] = so3.apply(self.shift_root, way - self.shift)
        first[:, :3, TURN] = -self.turn_root @ near @ so3.inverse(after) @ before
        second[:, :3, TURN] = self.turn_root @ near
        first[:, 3:, TURN] = self.shift_root @ so3.skew(way)
        first[:, 3:, PLACE] = -self.shift_root @ back
        second[:, 3:, PLACE] = self.shift_root @ back
        for half in (slice(0, 3), slice(3, 6)):
            weight = 1 / np.sqrt(1 + (np.linalg.norm(residual[:, half], axis=1) / robust) ** 2)
            residual[:, half] *= weight[:, None]
            first[:, half] *= weight[:, None, None]
            second[:, half] *= weight[:, None, None]
        equations.add(residual, self.first, first, self.second, second)
