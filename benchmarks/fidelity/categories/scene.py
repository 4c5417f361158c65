"""TRK, SCN and PAR: track assets, compiled scene, agreement of the simulators."""

import time
from importlib.metadata import requires

import mujoco
import numpy as np
from jaxtyping import Int
from packaging.requirements import Requirement
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, per_case
from benchmarks.fidelity.derive import contact, planar, track
from benchmarks.fidelity.derive.scene import (
    LINING_NAMES,
    asset_files,
    count_assets,
    fastening_sets,
    placed_data,
    rays_from_axis,
    robot_body,
    scene_geoms,
    scene_model,
    seat_mismatches,
)
from benchmarks.fidelity.registry import Samples, Statistic, Value, missing, number, pass_or_fail, rms
from benchmarks.fidelity.table import LOGGED_UP, B, D, P, U, metric
from scene.poses.trajectory import load_tum

_SLEEPER_MATCH = 0.15  # m
_BORE_MARGIN = 0.02  # m between a sleeper and the wall
_TWIST_BASE = 3.0  # m
_NO_SLEEPERS = "the reference shows no sleepers"
_NO_RAILS = "the reference shows no rails"
_NO_TRACK = "the candidate has no track"


@metric("trk_sleeper_f1", "TRK", U(0.7, 0.999999), gate=True, needs="reference")
def trk_sleeper_f1(case: Case) -> Value:
    """F1 of sleepers that are each other's nearest within 0.15 m; 0 where the truth has none but the candidate."""
    real, judged = track.reference_sleepers(track.reference_railway(case)), track.candidate_sleepers(case)
    if not len(real) and (case.truth is None or not len(judged)):
        return missing(_NO_SLEEPERS)
    if not len(real) or not len(judged):
        return number(0.0, len(real) + len(judged))
    gap, nearest = cKDTree(real).query(judged)
    back: Int[np.ndarray, " r"] = cKDTree(judged).query(real)[1]
    matched = (back[nearest] == np.arange(len(judged))) & (gap <= _SLEEPER_MATCH)
    return number(2.0 * matched.sum() / (len(real) + len(judged)), len(real) + len(judged))


@metric("trk_sleeper_count_rel_err", "TRK", D(1e-06, 8), "%", needs="reference")
def trk_sleeper_count_rel_err(case: Case) -> Value:
    """Relative difference of counts, %."""
    real, judged = track.reference_sleepers(track.reference_railway(case)), track.candidate_sleepers(case)
    if not len(real):
        return missing(_NO_SLEEPERS)
    return number(100.0 * abs(len(judged) - len(real)) / len(real), len(real))


@metric("trk_sleeper_spacing_err", "TRK", D(1e-06, 0.03), "m", needs="reference", evidence="HTK", args=(np.mean,))
@metric("trk_sleeper_spacing_std_err", "TRK", D(1e-06, 0.06), "m", needs="reference", args=(np.std,))
def spacing_error(case: Case, statistic: Statistic) -> Value:
    """Difference of mean or standard deviation of the spacings, missing sleepers left out, m."""
    real = track.sleeper_spacings(track.reference_sleepers(track.reference_railway(case)))
    judged = track.sleeper_spacings(track.candidate_sleepers(case))
    if not len(real):
        return missing(_NO_SLEEPERS)
    if not len(judged):
        return number(float("nan"), 0, "the candidate has no two sleepers side by side")
    return number(abs(float(statistic(judged)) - float(statistic(real))), len(judged))


@metric("trk_sleeper_in_bore", "TRK", U(0.98, 1))
def trk_sleeper_in_bore(case: Case) -> Value:
    """Fraction of sleepers whose top keeps 2 cm from the wall of the local section."""
    if not len(case.candidate.track.sleeper):
        return missing(_NO_TRACK)
    fits = track.sleepers_fit(case, _BORE_MARGIN)
    return number(float(np.mean(fits)), len(fits))


def _reference_gauge(case: Case) -> tuple[float | None, str]:
    """Return the gauge to be met and its source; `None` where the reference shows no rails."""
    reference = track.reference_railway(case)
    if not reference.rail.shape[1]:
        return None, _NO_RAILS
    if reference.gauge is not None:
        return reference.gauge, "against the truth's own rails"
    return track.STANDARD_GAUGE, "K: against the standard gauge, held-out returns being too coarse for millimetres"


@metric("trk_gauge_mean_err", "TRK", D(1e-06, 10), "mm", gate=True, needs="reference", evidence="HTK")
def trk_gauge_mean_err(case: Case) -> Value:
    """Error of the mean gauge of the exported rails, mm."""
    asked, reason = _reference_gauge(case)
    if asked is None:
        return missing(reason)
    return number(1e3 * abs(track.candidate_gauge(case).mean() - asked), len(track.candidate_gauge(case)), reason)


@metric("trk_gauge_p95_dev", "TRK", D(0.000524, 10), "mm", needs="reference", evidence="HTK")
def trk_gauge_p95_dev(case: Case) -> Value:
    """95th percentile of the deviation of the gauge along the track, mm."""
    asked, reason = _reference_gauge(case)
    if asked is None:
        return missing(reason)
    gauge = track.candidate_gauge(case)
    return number(1e3 * np.percentile(np.abs(gauge - asked), 95), len(gauge), reason)


@metric("trk_rail_lateral_rmse", "TRK", D(2.78e-06, 0.1), "m", needs="reference", of=rms, args=(1,))
@metric("trk_rail_height_rmse", "TRK", D(1e-06, 0.12), "m", needs="reference", of=rms, args=(2,))
def rail_offset(case: Case, column: int) -> Value | Samples:
    """Root mean square offset of the track's middle (1 lateral, 2 in height), m."""
    if not track.reference_railway(case).rail.shape[1]:
        return missing(_NO_RAILS)
    offsets = track.rail_offsets(case)
    return Samples(offsets[:, column], offsets[:, 0])


@metric("trk_rail_gap_max", "TRK", D(0.02, 0.5), "m")
def trk_rail_gap_max(case: Case) -> Value:
    """Longest stretch between the first and the last sleeper that a rail leaves out, m."""
    if not len(case.candidate.track.sleeper):
        return missing(_NO_TRACK)
    return number(max(track.rail_gaps(case)), 2)


@metric("trk_twist_p95", "TRK", unit="mm/m", evidence="K")
def trk_twist_p95(case: Case) -> Value:
    """95th percentile of the change of the rails' difference in height over 3 m, mm/m."""
    twist = 1e3 * np.abs(track.rail_twist(case, _TWIST_BASE))
    if not len(twist):
        return missing(_NO_TRACK)
    return number(np.percentile(twist, 95), len(twist), "K: railway practice judges twist on a base of 3 m")


@metric("trk_fastener_ratio", "TRK", B(1, 0.005, 0.1), evidence="K")
def trk_fastener_ratio(case: Case) -> Value:
    """Fastenings over rail seats, two to a sleeper."""
    count = 2 * len(case.candidate.track.sleeper)
    if not count:
        return missing(_NO_TRACK)
    return number(len(fastening_sets(case)) / count, count, "K: one fastening to a seat")


@metric("trk_asset_penetration_max", "TRK", D(0.005, 0.05), "m")
def trk_asset_penetration_max(case: Case) -> Value:
    """Largest overlap or gap of rail, pad, sleeper and bed, m."""
    if not len(case.candidate.track.sleeper):
        return missing(_NO_TRACK)
    mismatches = seat_mismatches(case)
    return number(np.abs(mismatches).max(), len(mismatches))


_STEPS = 1000
_PUSH = 0.5  # m/s
_SAME_POSE = 1e-6
_MASS_TOLERANCE = 0.01
_SAME_DEPTH = 1e-3  # m
_SIGMA = 0.05  # m; the range noise that the paper gives its environment


# SCN: the released scene is in MuJoCo what the meshes say.


@metric("mj_compiles", "SCN", P, "bool", gate=True)
def mj_compiles(case: Case) -> Value:
    """MuJoCo compiles the released MJCF."""
    try:
        model = scene_model(case)
    except ValueError as error:
        return pass_or_fail(False, str(error)[:200])
    return pass_or_fail(model.ngeom > 0, f"{model.ngeom} geoms")


@metric("mj_version_match", "SCN", LOGGED_UP, "bool", evidence="KC")
def mj_version_match(case: Case) -> Value:
    """The MuJoCo in use is one that this project asks for."""
    requirements = [Requirement(text) for text in requires("subterra-jax") or ()]
    pin = next(one for one in requirements if one.name == "mujoco" and one.marker is None)
    reason = (
        f"{mujoco.__version__}, asked for {pin.specifier} by the project's own metadata; "
        "not the paper's 3.8.1, because mujoco and mujoco-mjx must be of one release and MJX is tested at this one"
    )
    return pass_or_fail(pin.specifier.contains(mujoco.__version__), reason)


@metric("mj_step_finite", "SCN", P, "bool", gate=True)
def mj_step_finite(case: Case) -> Value:
    """1,000 steps of the robot, pushed forwards, stay finite and raise no warning."""
    state, warnings, _ = _push_robot(case)
    return pass_or_fail(bool(np.isfinite(state).all()) and warnings == 0, f"{warnings} warnings")


@per_case
def _push_robot(case: Case) -> tuple[np.ndarray, int, float]:
    """Return the last state, the number of warnings, and the steps per second."""
    model = scene_model(case)
    data = placed_data(model)
    body = robot_body(model)
    start = int(model.jnt_dofadr[model.body_jntadr[body]])
    data.qvel[start : start + 3] = _PUSH * data.xmat[body].reshape(3, 3)[:, 0]
    began = time.perf_counter()
    for _ in range(_STEPS):
        mujoco.mj_step(model, data)
    rate = _STEPS / (time.perf_counter() - began)
    return np.concatenate([data.qpos, data.qvel]), sum(int(w.number) for w in data.warning), rate


@metric("mj_probe_free_frac", "SCN", U(0.99, 1), gate=True)
def mj_probe_free_frac(case: Case) -> Value:
    """Fraction of axis stations where a sphere of 0.3 m touches nothing."""
    free = contact.probe_free(case)
    return number(free.mean(), len(free))


@metric("mj_wall_contact_err", "SCN", D(0.01, 0.08), "m", gate=True)
def mj_wall_contact_err(case: Case) -> Value:
    """Median difference between first contact in MuJoCo and in the mesh, towards both walls at LiDAR height, m.

    Of several sets of walls, for bodies that collide with different bits, the finest one counts.
    """
    sets, expected = contact.first_contacts(case)
    errors = [float(np.median(np.abs(made - expected))) for made in sets]
    reason = "by set of walls: " + ", ".join(f"{1e3 * error:.1f} mm" for error in errors)
    return number(errors[0], len(expected), reason)


@metric("mj_ray_vs_mesh_mae", "SCN", D(0.001, 0.02), "m")
def mj_ray_vs_mesh_mae(case: Case) -> Value:
    """Mean difference of ranges, compiled scene against the meshes, m."""
    scene, mesh, comparable = rays_from_axis(case)
    both = np.isfinite(scene) & np.isfinite(mesh) & comparable
    return number(np.mean(np.abs(scene[both] - mesh[both])), int(both.sum()))


@metric("mj_ray_leak_rate", "SCN", D(1e-05, 0.001))
def mj_ray_leak_rate(case: Case) -> Value:
    """Fraction of rays that meet the meshes and nothing in the scene."""
    scene, mesh, _ = rays_from_axis(case)
    due = np.isfinite(mesh)
    return number(np.mean(~np.isfinite(scene[due])), int(due.sum()))


@metric("mj_manifest_match", "SCN", P, "bool")
def mj_manifest_match(case: Case) -> Value:
    """The scene holds the numbers of assets that the manifest states."""
    counted, stated = count_assets(case), case.candidate.manifest.get("count", {})
    shared = sorted(set(counted) & set(stated))
    wrong = [f"{name}: {counted[name]} of {stated[name]}" for name in shared if counted[name] != stated[name]]
    reason = "; ".join(wrong) or ", ".join(f"{counted[n]} {n}" for n in shared)
    return pass_or_fail(bool(shared) and not wrong, reason)


@metric("mj_frame_err", "SCN", D(0.001, 0.02), "m")
def mj_frame_err(case: Case) -> Value:
    """Largest distance between a vertex of the compiled lining, the compiler's recentring undone, and the mesh's, m."""
    return number(_frame_error(case), len(case.candidate.lining.vertices))


@per_case
def _frame_error(case: Case) -> float:
    lining = scene_geoms(case).named(*LINING_NAMES)
    if not lining:
        raise ValueError("no geom of the scene is called lining")
    compiled = np.concatenate([scene_geoms(case).mesh(geom).vertices for geom in lining])
    expected = case.candidate.lining.vertices
    return float(max(cKDTree(expected).query(compiled)[0].max(), cKDTree(compiled).query(expected)[0].max()))


@metric("mj_inertia_valid", "SCN", LOGGED_UP, "bool", evidence="SKC")
def mj_inertia_valid(case: Case) -> Value:
    """Inertias are positive and possible for a body; compiled masses are those that the MJCF states."""
    model = scene_model(case)
    moving = [k for k in range(1, model.nbody) if model.body_weldid[k] != 0]
    if not moving:
        return pass_or_fail(False, "nothing in the scene moves")
    inertia = np.sort(model.body_inertia[moving], axis=1)
    possible = bool((inertia[:, 0] > 0).all() and (inertia[:, 2] <= inertia[:, 0] + inertia[:, 1] + 1e-9).all())
    stated = {
        body.name: sum(geom.mass for geom in body.geoms)
        for body in mujoco.MjSpec.from_file(str(case.candidate.scene)).bodies
    }
    mass = {model.body(k).name: float(model.body_mass[k]) for k in moving}
    # Geoms without a mass leave it to the body's own inertia, as the rover's do.
    off = [n for n, m in mass.items() if stated[n] > 0.0 and abs(m - stated[n]) > _MASS_TOLERANCE * stated[n]]
    valid = possible and not off and min(mass.values()) > 0
    return pass_or_fail(valid, ", ".join(f"{n} {m:g} kg" for n, m in mass.items()))


@metric("mj_xml_roundtrip", "SCN", P, "bool")
def mj_xml_roundtrip(case: Case) -> Value:
    """Written out and read again, the scene has the same geoms at the same places."""
    scene, before = case.candidate.scene, scene_model(case)
    files = {str(path.relative_to(scene.parent)): path.read_bytes() for path in asset_files(scene)}
    after = mujoco.MjSpec.from_string(mujoco.MjSpec.from_file(str(scene)).to_xml(), assets=files).compile()
    if (before.ngeom, before.nbody, before.nmesh) != (after.ngeom, after.nbody, after.nmesh):
        return pass_or_fail(False, f"{before.ngeom} geoms became {after.ngeom}")
    moved = max(
        float(np.abs(getattr(before, name) - getattr(after, name)).max())
        for name in ("geom_pos", "geom_quat", "geom_size", "body_pos", "body_quat")
    )
    return pass_or_fail(moved <= _SAME_POSE, f"moved by {moved:.1e}")


@metric("mj_step_rate", "SCN", unit="1/s")
def mj_step_rate(case: Case) -> Value:
    """Steps per second on the CPU, 1/s."""
    return number(_push_robot(case)[2], _STEPS)


# PAR: MJX, the JAX LiDAR and the environment agree with MuJoCo and with the meshes.


@metric("mjx_put_model", "PAR", P, "bool", gate=True)
def mjx_put_model(case: Case) -> Value:
    """MJX accepts the whole released scene and makes one compiled step."""
    try:
        return pass_or_fail(contact.step_is_finite(case))
    except (NotImplementedError, ValueError, RuntimeError) as error:
        return pass_or_fail(False, f"{type(error).__name__}: {error}"[:200])


@metric("mjx_ray_parity", "PAR", D(0.001, 0.02), "m")
def mjx_ray_parity(case: Case) -> Value:
    """Mean difference between the JAX LiDAR and `mj_multiRay` in the compiled scene at the same poses, m."""
    difference = np.abs(planar.lidar_ranges(case) - planar.mujoco_ranges(case))
    reason = "the JAX LiDAR sees walls and pockets in plan, no nails; track and crown lie outside its plane"
    return number(difference.mean(), difference.size, reason)


@metric("mjx_contact_parity", "PAR", U(0.95, 1))
def mjx_contact_parity(case: Case) -> Value:
    """Fraction of 200 placements of the robot with the same contact decision and a depth within 1 mm."""
    ours, theirs = contact.contact_depths(case)
    same = ((ours < 0.0) == (theirs < 0.0)) & (np.abs(ours - theirs) <= _SAME_DEPTH)
    return number(same.mean(), len(same), f"{np.mean(ours < 0.0):.0%} of them in contact")


@metric("mjx_traj_divergence", "PAR", D(0.001, 0.05), "m")
def mjx_traj_divergence(case: Case) -> Value:
    """Largest distance of the robot between MuJoCo and MJX over 100 steps, m."""
    gap = contact.path_divergence(case)
    return number(gap.max(), len(gap))


@metric("env_lidar_vs_mesh", "PAR", D(0.02, 0.15), "m", gate=True)
def env_lidar_vs_mesh(case: Case) -> Value:
    """Mean difference between the environment's noise-free beams and rays in the meshes, m."""
    difference = np.abs(planar.observed_ranges(case) - planar.mesh_ranges(case))
    return number(difference.mean(), difference.size)


@metric("env_noise_sigma_err", "PAR", unit="m", evidence="KC")
def env_noise_sigma_err(case: Case) -> Value:
    """Standard deviation of the environment's range noise against 5 cm, m."""
    noise = planar.range_noise(case)
    return number(abs(float(np.std(noise)) - _SIGMA), len(noise))


@metric("env_determinism", "PAR", LOGGED_UP, "bool", evidence="SC")
def env_determinism(case: Case) -> Value:
    """Same seed and actions give the same observations in two environments made one after the other."""
    same = planar.repeated_observations(case)
    return pass_or_fail(bool(same.all()), f"{int(same.sum())} of {len(same)} observations")


@metric("env_odom_drift_ratio", "PAR", needs="hold")
def env_odom_drift_ratio(case: Case) -> Value:
    """Decimal logarithm of the environment's drift over 100 m by that of the recording's own LiDAR odometry."""
    assert case.hold is not None
    path = case.candidate.folder / "odometry.tum"
    if not path.exists():
        return missing("poses were given, so that the recording has no LiDAR odometry of its own")
    odometry, hold = load_tum(path), case.hold
    first = np.flatnonzero(np.diff(hold.scan, prepend=-1))
    when = np.array([odometry.covers(t, t) for t in hold.time[first]])
    if when.sum() < 2:
        return missing("the odometry and the held-out recording have no time in common")
    beams = first[when]
    way = odometry.at(hold.time[beams])[0]
    arcs = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in (way, hold.origin[beams])]
    real = abs(arcs[0] - arcs[1]) * 100.0 / max(arcs[1], 1e-9)
    return number(np.log10(planar.odometry_drift(case) / max(real, 1e-6)), len(beams))
