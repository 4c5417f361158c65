"""Contacts in the compiled scene: a probe sphere in MuJoCo, and the robot in MJX beside MuJoCo."""

import io
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass

import jax
import mujoco
import numpy as np
from jaxtyping import Bool, Float

from benchmarks.fidelity.case import Case, kept_until, per_case
from benchmarks.fidelity.derive import scene
from benchmarks.fidelity.derive.curve import interpolate_rows
from benchmarks.fidelity.derive.surface import surface_caster, surface_nearest
from subterra_jax.host.tunnelfile import read_fields

PROBE_RADIUS = 0.3  # m
_PROBE_SPACING = 0.5  # m between the stations at which the bore must be free
_WALL_STATIONS = 40
_COARSE_STEP, _FINE_STEP = 0.1, 0.0005  # m
_EVERYTHING = 2**31 - 1  # touches whatever collides with anything


class Probe:
    """The compiled scene with a free sphere in it, which collides by `bits`, MuJoCo's `contype` and `conaffinity`."""

    def __init__(self, case: Case, bits: int = _EVERYTHING) -> None:
        spec = mujoco.MjSpec.from_file(str(case.candidate.scene))
        body = spec.worldbody.add_body(name="fidelity_probe")
        body.add_freejoint()
        size = [PROBE_RADIUS, 0.0, 0.0]
        body.add_geom(
            name="fidelity_probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, mass=1.0, contype=bits,
            conaffinity=bits,
        )  # fmt: skip
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._geom = self._model.geom("fidelity_probe").id
        self._adr = int(self._model.jnt_qposadr[self._model.body("fidelity_probe").jntadr[0]])

    def depth(self, position: Float[np.ndarray, "3"]) -> float:
        """Return the distance of the nearest contact with a fixed body, m; `inf` where there is none."""
        self._data.qpos[self._adr : self._adr + 3] = position
        mujoco.mj_fwdPosition(self._model, self._data)
        nearest = np.inf
        for contact in self._data.contact:
            pair = set(contact.geom.tolist())
            if self._geom in pair:
                other = (pair - {self._geom}).pop()
                if self._model.geom_bodyid[other] == 0:
                    nearest = min(nearest, float(contact.dist))
        return nearest


@per_case
def probe_free(case: Case) -> Bool[np.ndarray, " k"]:
    """Return True where the probe touches nothing, at each station of the centreline."""
    bore, probe = case.candidate.bore, Probe(case)
    station = np.arange(bore.station[0] + _PROBE_SPACING, bore.station[-1] - _PROBE_SPACING, _PROBE_SPACING)
    middle = interpolate_rows(station, bore.station, bore.position)
    return np.array([probe.depth(place) >= 0.0 for place in middle])


@per_case
def first_contacts(case: Case) -> tuple[list[Float[np.ndarray, " k"]], Float[np.ndarray, " k"]]:
    """Moves the probe from the middle to each wall at LiDAR height until it touches.

    A scene may hold walls in several sets, each for bodies that collide with one bit: true ones, and coarse ones that
    are fast.

    Returns:
        Offsets in MuJoCo for each bit that stands for walls, that of the most geoms first, and offsets at which the
        mesh is one radius away, m.
    """
    station, start, left = scene.random_stations(case, "mj_wall_contact_err", _WALL_STATIONS)
    start[:, 2] = scene.lidar_elevation(case, station)
    start, way = np.concatenate([start, start]), np.concatenate([left, -left])
    reach = surface_caster(case).first(start, way)[0]
    known = np.isfinite(reach)
    ways = list(zip(start[known], way[known], reach[known], strict=True))
    probes = [Probe(case, bit) for bit in _wall_bits(case)]
    walls = [probe for probe in probes if np.mean([probe.depth(a + r * w) < 0.0 for a, w, r in ways]) > 0.5]
    if not walls:
        raise ValueError("nothing in the scene stops a body at the walls")
    touched = [np.array([_first_touch(probe, *one) for one in ways]) for probe in walls]
    return touched, _mesh_touch(case, start[known], way[known], reach[known])


def _wall_bits(case: Case) -> list[int]:
    """Return the bits that geoms of the scene collide by, that of the most geoms first."""
    model = scene.scene_model(case)
    fixed = model.geom_bodyid == 0
    used = (model.geom_contype | model.geom_conaffinity)[fixed]
    count = {1 << k: int(np.sum(used >> k & 1)) for k in range(31)}
    return sorted((bit for bit in count if count[bit]), key=lambda bit: -count[bit])


def _first_touch(probe: Probe, start: np.ndarray, way: np.ndarray, reach: float) -> float:
    """Return the first offset with contact, m; half a metre behind the wall where there is none."""
    last = 0.0
    for offset in np.arange(0.0, reach + 0.5, _COARSE_STEP):
        if probe.depth(start + offset * way) < 0.0:
            break
        last = float(offset)
    else:
        return reach + 0.5
    if last == 0.0 and probe.depth(start) < 0.0:
        return 0.0
    low, high = last, last + _COARSE_STEP
    while high - low > _FINE_STEP:
        middle = (low + high) / 2
        low, high = (low, middle) if probe.depth(start + middle * way) < 0.0 else (middle, high)
    return high


def _mesh_touch(case: Case, start: np.ndarray, way: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return the offset at which the nearest surface is one radius away, by bisection, m."""
    low, high = np.zeros(len(reach)), reach.copy()
    for _ in range(13):
        middle = (low + high) / 2
        near = surface_nearest(case).query(start + middle[:, None] * way)[0] < PROBE_RADIUS
        low, high = np.where(near, low, middle), np.where(near, middle, high)
    return high


with redirect_stdout(io.StringIO()):  # it prints that warp, which nothing here needs, is not installed
    from mujoco import mjx
# The robot in MJX beside MuJoCo; the step is compiled once for each content of the scene.

_PLACEMENTS = 200
_DIVERGENCE_STEPS = 100
_PUSH_SPEEDS = (0.5, 0.3)  # m/s forwards, rad/s
_BY_WALL = 0.3  # m; how far from first contact the placements go either way
_LIFT = (-0.01, 0.02)  # m about where the robot stands at first


@dataclass(frozen=True)
class Stepper:
    """One compiled step of the scene."""

    step: Callable[[mjx.Data], mjx.Data]  # Function from MJX data to MJX data
    model: mujoco.MjModel  # Model of MuJoCo
    data: mjx.Data  # MJX data of the model's first pose

    def at(self, qpos: np.ndarray, qvel: np.ndarray) -> mjx.Data:
        return self.data.replace(qpos=jax.numpy.asarray(qpos), qvel=jax.numpy.asarray(qvel))


@kept_until("PAR", per_case)
def stepper(case: Case) -> Stepper:
    model = scene.scene_model(case)
    device = mjx.put_model(model)
    data = mjx.make_data(device)
    # 300 steps are made: at the usual level the compiler takes twice as long, longer than all of them.
    step = jax.jit(mjx.step, compiler_options={"xla_backend_optimization_level": 0})
    return Stepper(lambda state: step(device, state), model, data)


@per_case
def step_is_finite(case: Case) -> bool:
    compiled = stepper(case)
    after = compiled.step(compiled.data)
    return bool(np.isfinite(np.asarray(after.qpos)).all() and np.isfinite(np.asarray(after.qvel)).all())


@per_case
def contact_depths(case: Case) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return the deepest contact of the robot at random places, by MuJoCo and by MJX, m; 0 without contact."""
    compiled = stepper(case)
    cpu = mujoco.MjData(compiled.model)
    ours, theirs = np.zeros(_PLACEMENTS), np.zeros(_PLACEMENTS)
    still = np.zeros(compiled.model.nv)
    for k, qpos in enumerate(_poses_by_wall(case, compiled.model)):
        cpu.qpos[:], cpu.qvel[:] = qpos, 0.0
        mujoco.mj_forward(compiled.model, cpu)
        # A step reports the contacts of the pose that it starts from.
        device = mjx.get_data(compiled.model, compiled.step(compiled.at(qpos, still)))
        ours[k], theirs[k] = (min(float(np.min(data.contact.dist, initial=0.0)), 0.0) for data in (cpu, device))
    return ours, theirs


def _poses_by_wall(case: Case, model: mujoco.MjModel) -> Float[np.ndarray, "k q"]:
    """Return poses of the robot by either wall, from clear of it to a little inside, at random headings."""
    rng = case.rng("mjx_contact_parity")
    station, middle, left = scene.random_stations(case, "mjx_contact_parity", _PLACEMENTS)
    adr = int(model.jnt_qposadr[model.body_jntadr[scene.robot_body(model)]])
    first = model.qpos0[adr : adr + 3]
    tunnel = read_fields(case.candidate.tunnel)
    half = np.interp(station, tunnel["station"], tunnel["half_width"])
    ground = np.interp(station, tunnel["station"], tunnel["elevation"])
    start = tunnel["elevation"][np.argmin(np.linalg.norm(tunnel["centre"] - first[:2], axis=1))]
    lateral = half - _robot_radius(model) + rng.uniform(-_BY_WALL, _BY_WALL, _PLACEMENTS)
    place = middle + (rng.choice([-1.0, 1.0], _PLACEMENTS) * lateral)[:, None] * left
    place[:, 2] = ground + first[2] - start + rng.uniform(*_LIFT, _PLACEMENTS)
    yaw = rng.uniform(-np.pi, np.pi, _PLACEMENTS)
    qpos = np.tile(model.qpos0, (_PLACEMENTS, 1))
    qpos[:, adr : adr + 3] = place
    zero = np.zeros_like(yaw)
    qpos[:, adr + 3 : adr + 7] = np.column_stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)])
    return qpos


def _robot_radius(model: mujoco.MjModel) -> float:
    """Return the largest horizontal reach of the robot's geoms from its origin, m."""
    body = scene.robot_body(model)
    own = range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
    return float(max(np.hypot(*model.geom_pos[k, :2]) + model.geom_size[k, 0] for k in own))


@per_case
def path_divergence(case: Case) -> Float[np.ndarray, " k"]:
    """Return the distance between the robot's positions by MuJoCo and by MJX after each of 100 steps, m."""
    compiled = stepper(case)
    body = scene.robot_body(compiled.model)
    joint = compiled.model.body_jntadr[body]
    place, speed = int(compiled.model.jnt_qposadr[joint]), int(compiled.model.jnt_dofadr[joint])
    cpu = scene.placed_data(compiled.model)
    cpu.qvel[speed : speed + 3] = _PUSH_SPEEDS[0] * cpu.xmat[body].reshape(3, 3)[:, 0]
    cpu.qvel[speed + 5] = _PUSH_SPEEDS[1]
    device = compiled.at(cpu.qpos.copy(), cpu.qvel.copy())
    gap = np.zeros(_DIVERGENCE_STEPS)
    for k in range(_DIVERGENCE_STEPS):
        mujoco.mj_step(compiled.model, cpu)
        device = compiled.step(device)
        gap[k] = np.linalg.norm(cpu.qpos[place : place + 3] - np.asarray(device.qpos)[place : place + 3])
    return gap
