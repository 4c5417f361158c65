"""A tunnel continued by itself, for lengths that no packaged one has."""

from dataclasses import dataclass, replace
from math import ceil

import numpy as np
from jaxtyping import Float

from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall


@dataclass(frozen=True)
class _Pose:
    """Where one copy begins: `turn` maps vectors of the plan, mirrored or not, into the frame of the joined tunnel."""

    origin: Float[np.ndarray, "2"]
    turn: Float[np.ndarray, "2 2"]
    start: Float[np.ndarray, "2"]
    mirrored: bool

    def point(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Points of the plan where this copy has them, m."""
        return self.start + (points - self.origin) @ self.turn.T

    def segments(self, segments: Float[np.ndarray, "f 4"]) -> Float[np.ndarray, "f 4"]:
        """Segments of the plan where this copy has them, m."""
        return np.hstack([self.point(segments[:, :2]), self.point(segments[:, 2:])])


def of_length(plan: TunnelPlan, length: float) -> TunnelPlan:
    """The first metres of a tunnel, or, where it is too short, of it continued by itself.

    Every second copy is mirrored, so that bends cancel and the tunnel does not meet itself. Where two copies meet,
    walls run straight from one to the next and the centreline has no kink.

    Args:
        plan: The tunnel.
        length: Wanted length, m.
    """
    n_copies = ceil(length / plan.length - 1e-9)
    return (plan if n_copies <= 1 else _joined(plan, n_copies)).slice(0.0, length)


def _joined(plan: TunnelPlan, n_copies: int) -> TunnelPlan:
    poses = _poses(plan, n_copies)
    spacing = plan.length / (len(plan.station) - 1)
    rise = plan.elevation[-1] - plan.elevation[0]

    def chained(parts: list[np.ndarray]) -> np.ndarray:
        """Values at the nodes; the last node of a copy is the first of the next."""
        return np.concatenate([parts[0], *(part[1:] for part in parts[1:])])

    station = np.arange(n_copies * (len(plan.station) - 1) + 1) * spacing
    return replace(
        plan,
        name=f"{plan.name}, {n_copies} in a row",
        station=station,
        centre=chained([pose.point(plan.centre) for pose in poses]),
        tangent=chained([plan.tangent @ pose.turn.T for pose in poses]),
        elevation=chained([plan.elevation + k * rise for k in range(n_copies)]),
        half_width=chained([plan.half_width] * n_copies),
        linings={name: _lining(lining, poses, plan.length) for name, lining in plan.linings.items()},
    )


def _poses(plan: TunnelPlan, n_copies: int) -> list[_Pose]:
    """Each copy begins where, and in the direction in which, the last one ends."""
    point, tangent = plan.centre[0], plan.tangent[0]
    poses = []
    for k in range(n_copies):
        mirrored = bool(k % 2)
        own = _frame(plan.tangent[0], mirrored)
        poses.append(_Pose(plan.centre[0], _frame(tangent, False) @ own.T, point, mirrored))
        point, tangent = poses[-1].point(plan.centre[-1:])[0], poses[-1].turn @ plan.tangent[-1]
    return poses


def _frame(tangent: Float[np.ndarray, "2"], mirrored: bool) -> Float[np.ndarray, "2 2"]:
    """Unit vectors along and to the left of a direction, as columns; to its right where mirrored."""
    left = np.array([-tangent[1], tangent[0]]) * (-1.0 if mirrored else 1.0)
    return np.column_stack([tangent, left])


def _lining(lining: Lining, poses: list[_Pose], length: float) -> Lining:
    left = [lining.right if pose.mirrored else lining.left for pose in poses]
    right = [lining.left if pose.mirrored else lining.right for pose in poses]
    furniture = np.concatenate([pose.segments(lining.furniture) for pose in poses])
    return Lining(_wall(left, poses, length), _wall(right, poses, length), furniture)


def _wall(parts: list[Wall], poses: list[_Pose], length: float) -> Wall:
    return Wall(
        vertex=np.concatenate([pose.point(part.vertex) for pose, part in zip(poses, parts, strict=True)]),
        station=np.concatenate([part.station + k * length for k, part in enumerate(parts)]),
    )
