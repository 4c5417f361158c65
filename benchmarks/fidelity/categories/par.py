"""PAR: whether MJX, the JAX LiDAR and the environment agree with MuJoCo and with the meshes."""

import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import episodes, mjxscene, planarenv
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, missing, number, passed
from scene.poses.trajectory import load_tum

_SAME_DEPTH = 1e-3  # m
_SIGMA = 0.05  # m; the range noise that the paper gives its environment


@metric("mjx_put_model")
def mjx_put_model(case: Case) -> Value:
    """MJX takes the whole released scene and makes one compiled step."""
    try:
        return passed(mjxscene.steps_finite(case))
    except (NotImplementedError, ValueError, RuntimeError) as error:
        return passed(False, f"{type(error).__name__}: {error}"[:200])


@metric("mjx_ray_parity")
def mjx_ray_parity(case: Case) -> Value:
    """Mean difference between the JAX LiDAR and `mj_multiRay` in the compiled scene at the same poses, m."""
    difference = np.abs(planarenv.lidar_ranges(case) - planarenv.mujoco_ranges(case))
    reason = "the JAX LiDAR sees walls and pockets in plan, no nails; track and crown lie outside its plane"
    return number(difference.mean(), difference.size, reason)


@metric("mjx_contact_parity")
def mjx_contact_parity(case: Case) -> Value:
    """Share of 200 placements of the robot with the same contact decision and a depth within 1 mm."""
    ours, theirs = mjxscene.contacts(case)
    same = ((ours < 0.0) == (theirs < 0.0)) & (np.abs(ours - theirs) <= _SAME_DEPTH)
    return number(same.mean(), len(same), f"{np.mean(ours < 0.0):.0%} of them in contact")


@metric("mjx_traj_divergence")
def mjx_traj_divergence(case: Case) -> Value:
    """Largest distance of the robot between MuJoCo and MJX over 100 steps, m."""
    gap = mjxscene.divergence(case)
    return number(gap.max(), len(gap))


@metric("env_lidar_vs_mesh")
def env_lidar_vs_mesh(case: Case) -> Value:
    """Mean difference between the environment's noise-free beams and rays in the meshes, m."""
    difference = np.abs(planarenv.observed_ranges(case) - planarenv.mesh_ranges(case))
    return number(difference.mean(), difference.size)


@metric("env_noise_sigma_err")
def env_noise_sigma_err(case: Case) -> Value:
    """Standard deviation of the environment's range noise against 5 cm, m."""
    noise = planarenv.noise(case)
    return number(abs(float(np.std(noise)) - _SIGMA), len(noise))


@metric("env_determinism")
def env_determinism(case: Case) -> Value:
    """Same seed and actions, same observations, in two environments made one after the other."""
    same = episodes.repeats(case)
    return passed(bool(same.all()), f"{int(same.sum())} of {len(same)} observations")


@metric("env_odom_drift_ratio", needs="hold")
def env_odom_drift_ratio(case: Case) -> Value:
    """Decimal logarithm of the environment's drift over 100 m by that of the recording's own LiDAR odometry."""
    assert case.hold is not None
    path = case.candidate.folder / "odometry.tum"
    if not path.exists():
        return missing("poses were given, so that the recording has no LiDAR odometry of its own")
    estimate, hold = load_tum(path), case.hold
    first = np.flatnonzero(np.diff(hold.scan, prepend=-1))
    when = np.array([estimate.covers(t, t) for t in hold.time[first]])
    if when.sum() < 2:
        return missing("the odometry and the held-out recording have no time in common")
    chosen = first[when]
    way = estimate.at(hold.time[chosen])[0]
    arcs = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in (way, hold.origin[chosen])]
    real = abs(arcs[0] - arcs[1]) * 100.0 / max(arcs[1], 1e-9)
    return number(np.log10(episodes.odometry_drift(case) / max(real, 1e-6)), len(chosen))
