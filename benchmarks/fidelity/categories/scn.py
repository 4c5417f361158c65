"""SCN: whether the released scene is in MuJoCo what the meshes say it is."""

import time
from importlib.metadata import requires

import mujoco
import numpy as np
from packaging.requirements import Requirement
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.compiled import geom_mesh
from benchmarks.fidelity.derive import inventory, probe, released, scenerays
from benchmarks.fidelity.derive.released import of_released
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, number, passed

_STEPS = 1000
_PUSH = 0.5  # m/s
_SAME = 1e-6
_MASS_TOLERANCE = 0.01


@metric("mj_compiles")
def mj_compiles(case: Case) -> Value:
    """MuJoCo takes the released MJCF."""
    try:
        model = released.model(case)
    except ValueError as error:
        return passed(False, str(error)[:200])
    return passed(model.ngeom > 0, f"{model.ngeom} geoms")


@metric("mj_version_match")
def mj_version_match(case: Case) -> Value:
    """MuJoCo at work is one that this project asks for."""
    wanted = [Requirement(text) for text in requires("subterra-jax") or ()]
    pin = next(one for one in wanted if one.name == "mujoco" and one.marker is None)
    reason = (
        f"{mujoco.__version__}, asked for {pin.specifier} by the project's own metadata; "
        "not the paper's 3.8.1, because mujoco and mujoco-mjx must be of one release and MJX is tested at this one"
    )
    return passed(pin.specifier.contains(mujoco.__version__), reason)


@metric("mj_step_finite")
def mj_step_finite(case: Case) -> Value:
    """1,000 steps of the robot, pushed forwards, stay finite and raise no warning."""
    state, warnings, _ = _run(case)
    return passed(bool(np.isfinite(state).all()) and warnings == 0, f"{warnings} warnings")


@of_released("scene")
def _run(case: Case) -> tuple[np.ndarray, int, float]:
    """Last state, warnings, and steps per second."""
    model = released.model(case)
    data = released.placed(model)
    body = released.robot(model)
    start = int(model.jnt_dofadr[model.body_jntadr[body]])
    data.qvel[start : start + 3] = _PUSH * data.xmat[body].reshape(3, 3)[:, 0]
    began = time.perf_counter()
    for _ in range(_STEPS):
        mujoco.mj_step(model, data)
    rate = _STEPS / (time.perf_counter() - began)
    return np.concatenate([data.qpos, data.qvel]), sum(int(w.number) for w in data.warning), rate


@metric("mj_probe_free_frac")
def mj_probe_free_frac(case: Case) -> Value:
    """Share of axis stations where a sphere of 0.3 m touches nothing."""
    free = probe.free(case)
    return number(free.mean(), len(free))


@metric("mj_wall_contact_err")
def mj_wall_contact_err(case: Case) -> Value:
    """Median difference between first contact in MuJoCo and in the mesh, towards both walls at LiDAR height, m.

    Of several sets of walls, for bodies that collide with different bits, the finest one counts.
    """
    sets, meant = probe.first_contacts(case)
    errors = [float(np.median(np.abs(made - meant))) for made in sets]
    reason = "by set of walls: " + ", ".join(f"{1e3 * error:.1f} mm" for error in errors)
    return number(errors[0], len(meant), reason)


@metric("mj_ray_vs_mesh_mae")
def mj_ray_vs_mesh_mae(case: Case) -> Value:
    """Mean difference of ranges, compiled scene against the meshes, m."""
    pairs = scenerays.from_axis(case)
    both = np.isfinite(pairs.scene) & np.isfinite(pairs.mesh) & pairs.comparable
    return number(np.mean(np.abs(pairs.scene[both] - pairs.mesh[both])), int(both.sum()))


@metric("mj_ray_leak_rate")
def mj_ray_leak_rate(case: Case) -> Value:
    """Share of rays that meet the meshes and nothing in the scene."""
    pairs = scenerays.from_axis(case)
    due = np.isfinite(pairs.mesh)
    return number(np.mean(~np.isfinite(pairs.scene[due])), int(due.sum()))


@metric("mj_manifest_match")
def mj_manifest_match(case: Case) -> Value:
    """What the manifest counts is in the scene."""
    found, stated = inventory.of_scene(case), case.candidate.manifest.get("count", {})
    shared = sorted(set(found) & set(stated))
    wrong = [f"{name}: {found[name]} of {stated[name]}" for name in shared if found[name] != stated[name]]
    return passed(bool(shared) and not wrong, "; ".join(wrong) or ", ".join(f"{found[n]} {n}" for n in shared))


@metric("mj_frame_err")
def mj_frame_err(case: Case) -> Value:
    """Largest distance between a vertex of the compiled lining, the compiler's recentring undone, and the mesh's, m."""
    return number(_frame_error(case), len(case.candidate.lining.vertices))


@of_released("scene", "mesh")
def _frame_error(case: Case) -> float:
    model = released.model(case)
    data = released.placed(model)
    lining = [k for k in range(model.ngeom) if model.geom(k).name.split("_")[0] in scenerays.LINING]
    if not lining:
        raise ValueError("no geom of the scene is called lining")
    made, meant = np.concatenate([geom_mesh(model, data, k).vertices for k in lining]), case.candidate.lining.vertices
    return float(max(cKDTree(meant).query(made)[0].max(), cKDTree(made).query(meant)[0].max()))


@metric("mj_inertia_valid")
def mj_inertia_valid(case: Case) -> Value:
    """Inertias positive and such as a body can have; compiled masses those that the MJCF states."""
    model = released.model(case)
    moving = [k for k in range(1, model.nbody) if model.body_weldid[k] != 0]
    if not moving:
        return passed(False, "nothing in the scene moves")
    inertia = np.sort(model.body_inertia[moving], axis=1)
    possible = bool((inertia[:, 0] > 0).all() and (inertia[:, 2] <= inertia[:, 0] + inertia[:, 1] + 1e-9).all())
    stated = {
        body.name: sum(geom.mass for geom in body.geoms)
        for body in mujoco.MjSpec.from_file(str(case.candidate.scene)).bodies
    }
    mass = {model.body(k).name: float(model.body_mass[k]) for k in moving}
    off = [n for n, m in mass.items() if np.isfinite(stated[n]) and abs(m - stated[n]) > _MASS_TOLERANCE * stated[n]]
    return passed(possible and not off and min(mass.values()) > 0, ", ".join(f"{n} {m:g} kg" for n, m in mass.items()))


@metric("mj_xml_roundtrip")
def mj_xml_roundtrip(case: Case) -> Value:
    """Written out and read again, the scene has the same geoms at the same places."""
    scene, before = case.candidate.scene, released.model(case)
    files = {str(path.relative_to(scene.parent)): path.read_bytes() for path in released.assets(scene)}
    after = mujoco.MjSpec.from_string(mujoco.MjSpec.from_file(str(scene)).to_xml(), assets=files).compile()
    if (before.ngeom, before.nbody, before.nmesh) != (after.ngeom, after.nbody, after.nmesh):
        return passed(False, f"{before.ngeom} geoms became {after.ngeom}")
    moved = max(
        float(np.abs(getattr(before, name) - getattr(after, name)).max())
        for name in ("geom_pos", "geom_quat", "geom_size", "body_pos", "body_quat")
    )
    return passed(moved <= _SAME, f"moved by {moved:.1e}")


@metric("mj_step_rate")
def mj_step_rate(case: Case) -> Value:
    """CPU steps per second."""
    return number(_run(case)[2], _STEPS)
