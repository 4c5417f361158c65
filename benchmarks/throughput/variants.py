"""Cost of a step by length of tunnel and by lining; a tunnel too short is continued by mirrored copies of itself."""

from dataclasses import dataclass, replace
from math import ceil

import numpy as np
from jaxtyping import Float

import subterra_jax as st
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.measure import environment_loop, measure_exactness, spread_loop
from benchmarks.throughput.timing import Speed, Timing, measure_in_turn
from subterra_jax.lidar.reference import Agreement
from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall

_TASK = "Subterra/Traverse-v1"  # whose piece is the whole tunnel


@dataclass(frozen=True)
class Variant:
    """One of several tunnels, timed in turn with the others.

    Attributes:
        name: Length (m) or lining.
        n_segments: Number of wall segments of the tunnel.
        speed: Speed of its environment.
        cost: Step time relative to the first variant in the same round: lower quartile, median, upper quartile.
        exactness: Comparison of the LiDAR with the reference; `None` if skipped.
    """

    name: str
    n_segments: int
    speed: Speed
    cost: tuple[float, float, float]
    exactness: Agreement | None


def measure_lengths(plan: st.TunnelPlan, lining: str, config: ThroughputConfig, timing: Timing) -> list[Variant]:
    """Measures a step by length of tunnel; every call starts with robots spread along the tunnel."""
    bare = replace(plan, linings={lining: plan.lining(lining)})  # other linings take long to cut
    plans = [extend_tunnel(bare, length) for length in config.lengths]
    made = [st.make(_TASK, each, lining) for each in plans]
    loops = [spread_loop(env, params, config.study_size()) for env, params in made]
    speeds = measure_in_turn(loops, config.study_size(), timing, restart=True)
    gates = [_gate(each, lining, params, config) for each, (_, params) in zip(plans, made, strict=True)]
    sizes = [len(each.lining(lining).segments) for each in plans]
    return _variants([f"{length:g} m" for length in config.lengths], sizes, speeds, gates)


def measure_linings(plan: st.TunnelPlan, config: ThroughputConfig, timing: Timing) -> list[Variant]:
    """Measures a step by lining of the same tunnel."""
    made = [st.make(config.task, plan, lining) for lining in config.linings]
    loops = [environment_loop(env, params, config.study_size()) for env, params in made]
    speeds = measure_in_turn(loops, config.study_size(), timing)
    gates = [_gate(plan, name, st.make(_TASK, plan, name)[1], config) for name in config.linings]
    sizes = [len(plan.lining(name).segments) for name in config.linings]
    return _variants(list(config.linings), sizes, speeds, gates)


def _gate(plan: st.TunnelPlan, lining: str, params: st.EnvParams, config: ThroughputConfig) -> Agreement | None:
    # A tenth of the poses: brute force costs as many times more as the tunnel is longer.
    n_poses = -(-config.poses // 10)
    return measure_exactness(plan, lining, params, n_poses, config.seed) if n_poses else None


def _variants(names: list[str], sizes: list[int], speeds: list[Speed], gates: list[Agreement | None]) -> list[Variant]:
    first = np.asarray(speeds[0].steps_per_second)
    variants = []
    for name, size, speed, gate in zip(names, sizes, speeds, gates, strict=True):
        lower, median, upper = np.percentile(first / np.asarray(speed.steps_per_second), [25, 50, 75])
        variants.append(Variant(name, size, speed, (float(lower), float(median), float(upper)), gate))
    return variants


@dataclass(frozen=True)
class _Pose:
    """Pose of one copy: `turn` maps vectors of the plan, mirrored or not, into the frame of the joined tunnel."""

    origin: Float[np.ndarray, "2"]
    turn: Float[np.ndarray, "2 2"]
    start: Float[np.ndarray, "2"]
    mirrored: bool

    def point(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Returns points of the plan at their place in this copy, m."""
        return self.start + (points - self.origin) @ self.turn.T

    def segments(self, segments: Float[np.ndarray, "f 4"]) -> Float[np.ndarray, "f 4"]:
        """Returns segments of the plan at their place in this copy, m."""
        return np.hstack([self.point(segments[:, :2]), self.point(segments[:, 2:])])


def extend_tunnel(plan: TunnelPlan, length: float) -> TunnelPlan:
    """Returns the first metres of a tunnel, continued by copies of itself where it is too short.

    Every second copy is mirrored, so that bends cancel and the tunnel does not meet itself. Between two copies the
    walls run straight and the centreline has no kink.

    Args:
        plan: Tunnel.
        length: Length of the result, m.
    """
    n_copies = ceil(length / plan.length - 1e-9)
    return (plan if n_copies <= 1 else _join_copies(plan, n_copies)).slice(0.0, length)


def _join_copies(plan: TunnelPlan, n_copies: int) -> TunnelPlan:
    poses = _poses(plan, n_copies)
    spacing = plan.length / (len(plan.station) - 1)
    rise = plan.elevation[-1] - plan.elevation[0]

    def chain(parts: list[np.ndarray]) -> np.ndarray:
        """Joins values at the nodes; the last node of a copy is the first of the next."""
        return np.concatenate([parts[0], *(part[1:] for part in parts[1:])])

    station = np.arange(n_copies * (len(plan.station) - 1) + 1) * spacing
    return replace(
        plan,
        name=f"{plan.name}, {n_copies} in a row",
        station=station,
        centre=chain([pose.point(plan.centre) for pose in poses]),
        tangent=chain([plan.tangent @ pose.turn.T for pose in poses]),
        elevation=chain([plan.elevation + k * rise for k in range(n_copies)]),
        half_width=chain([plan.half_width] * n_copies),
        linings={name: _lining(lining, poses, plan.length) for name, lining in plan.linings.items()},
    )


def _poses(plan: TunnelPlan, n_copies: int) -> list[_Pose]:
    """Returns the pose of each copy; it starts at the end of the last one, in the same direction."""
    point, tangent = plan.centre[0], plan.tangent[0]
    poses = []
    for k in range(n_copies):
        mirrored = bool(k % 2)
        own = _frame(plan.tangent[0], mirrored)
        poses.append(_Pose(plan.centre[0], _frame(tangent, False) @ own.T, point, mirrored))
        point, tangent = poses[-1].point(plan.centre[-1:])[0], poses[-1].turn @ plan.tangent[-1]
    return poses


def _frame(tangent: Float[np.ndarray, "2"], mirrored: bool) -> Float[np.ndarray, "2 2"]:
    """Returns unit vectors along and to the left of a direction as columns; to its right if mirrored."""
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
