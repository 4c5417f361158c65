"""Where things of a planar tunnel are in three dimensions."""

import dataclasses

import numpy as np
from jaxtyping import Float

from subterra_jax.tunnel.plan import TunnelPlan


@dataclasses.dataclass(frozen=True)
class Course:
    """A tunnel's centreline with its ground.

    Attributes:
        plan: The tunnel.
    """

    plan: TunnelPlan

    def ground(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Height of the ground, m; level beyond the mouths."""
        return np.interp(station, self.plan.station, self.plan.elevation)

    def place(self, station: Float[np.ndarray, "n"], lateral: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Points on the ground, m, `lateral` metres to the left of the centreline; straight on beyond the mouths."""
        centre, tangent = self.frame(station)
        offset = lateral[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
        return np.column_stack([centre + offset, self.ground(station)])

    def frame(self, station: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        """Centre (m) and unit tangent in plan."""
        plan = self.plan
        centre, tangent = (
            np.stack([np.interp(station, plan.station, values[:, i]) for i in range(2)], axis=-1)
            for values in (plan.centre, plan.tangent)
        )
        tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
        beyond = station - np.clip(station, 0.0, plan.length)
        return centre + beyond[:, None] * tangent, tangent

    def lifted(
        self, points: Float[np.ndarray, "n 2"], station: Float[np.ndarray, "n"], above: float
    ) -> Float[np.ndarray, "n 3"]:
        """Plan positions with the height `above` the ground at their stations, m."""
        return np.column_stack([points, self.ground(station) + above])


def dead_reckoned(
    position: Float[np.ndarray, "2"], heading: float, odometry: Float[np.ndarray, "t 2"]
) -> Float[np.ndarray, "t 2"]:
    """Where the odometer alone would have the robot.

    Args:
        position: True position at the start, m.
        heading: True heading at the start, rad.
        odometry: Dead-reckoned distance (m) and heading since the start (rad).

    Returns:
        Positions, m: each step along the mean of the headings before and after it.
    """
    turned = heading + np.unwrap(odometry[:, 1].astype(np.float64))
    middle, moved = 0.5 * (turned[1:] + turned[:-1]), np.diff(odometry[:, 0].astype(np.float64))
    steps = moved[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    return position + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
