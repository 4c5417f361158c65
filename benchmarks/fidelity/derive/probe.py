"""A sphere in the compiled scene: where it touches, and where it should."""

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive import released, surface
from benchmarks.fidelity.derive.released import of_released

RADIUS = 0.3  # m
_SPACING = 0.5  # m between the stations at which the bore must be free
_WALL_STATIONS = 40
_COARSE, _FINE = 0.1, 0.0005  # m
_EVERYTHING = 2**31 - 1  # touches whatever collides with anything


class Probe:
    """The scene with a free sphere in it.

    Args:
        case: Whose scene.
        bits: What the sphere collides with, as MuJoCo's `contype` and `conaffinity` name it.
    """

    def __init__(self, case: Case, bits: int = _EVERYTHING) -> None:
        spec = mujoco.MjSpec.from_file(str(case.candidate.scene))
        body = spec.worldbody.add_body(name="fidelity_probe")
        body.add_freejoint()
        size = [RADIUS, 0.0, 0.0]
        body.add_geom(
            name="fidelity_probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, mass=1.0, contype=bits,
            conaffinity=bits,
        )  # fmt: skip
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._geom = self._model.geom("fidelity_probe").id
        self._adr = int(self._model.jnt_qposadr[self._model.body("fidelity_probe").jntadr[0]])

    def depth(self, position: Float[np.ndarray, "3"]) -> float:
        """Distance of the nearest contact with something that does not move, m; `inf` where there is none."""
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


@of_released("scene", "mesh")
def free(case: Case) -> Bool[np.ndarray, " k"]:
    """Whether the probe touches nothing, at each station of the centreline."""
    bore, probe = case.candidate.bore, Probe(case)
    station = np.arange(bore.station[0] + _SPACING, bore.station[-1] - _SPACING, _SPACING * case.tolerance)
    middle = np.stack([np.interp(station, bore.station, column) for column in bore.position.T], axis=1)
    return np.array([probe.depth(place) >= 0.0 for place in middle])


@of_released("scene", "mesh", "tunnel")
def first_contacts(case: Case) -> tuple[list[Float[np.ndarray, " k"]], Float[np.ndarray, " k"]]:
    """How far the probe goes from the middle to each wall at LiDAR height before it touches.

    A scene may hold walls in several sets, each for bodies that collide with one bit: true ones, and coarse ones that
    are fast.

    Returns:
        Offsets in MuJoCo for each bit that stands for walls, that of the most geoms first, and offsets at which the
        mesh is one radius away, m.

    Raises:
        ValueError: No bit stands for walls.
    """
    station, start, left = released.along_axis(case, "mj_wall_contact_err", _WALL_STATIONS)
    start[:, 2] = released.lidar_elevation(case, station)
    start, way = np.concatenate([start, start]), np.concatenate([left, -left])
    reach = surface.intersector(case).first(start, way)[0]
    known = np.isfinite(reach)
    ways = list(zip(start[known], way[known], reach[known], strict=True))
    probes = [Probe(case, bit) for bit in _bits(case)]
    walls = [probe for probe in probes if np.mean([probe.depth(a + r * w) < 0.0 for a, w, r in ways]) > 0.5]
    if not walls:
        raise ValueError("nothing in the scene stops a body at the walls")
    touched = [np.array([_touch(probe, *one) for one in ways]) for probe in walls]
    return touched, _mesh_touch(case, start[known], way[known], reach[known])


def _bits(case: Case) -> list[int]:
    """The bits that geoms of the scene collide by, that of the most geoms first."""
    model = released.model(case)
    fixed = model.geom_bodyid == 0
    used = (model.geom_contype | model.geom_conaffinity)[fixed]
    count = {1 << k: int(np.sum(used >> k & 1)) for k in range(31)}
    return sorted((bit for bit in count if count[bit]), key=lambda bit: -count[bit])


def _touch(probe: Probe, start: np.ndarray, way: np.ndarray, reach: float) -> float:
    """First offset with contact, m; half a metre behind the wall where there is none."""
    last = 0.0
    for offset in np.arange(0.0, reach + 0.5, _COARSE):
        if probe.depth(start + offset * way) < 0.0:
            break
        last = float(offset)
    else:
        return reach + 0.5
    if last == 0.0 and probe.depth(start) < 0.0:
        return 0.0
    low, high = last, last + _COARSE
    while high - low > _FINE:
        middle = (low + high) / 2
        low, high = (low, middle) if probe.depth(start + middle * way) < 0.0 else (middle, high)
    return high


def _mesh_touch(case: Case, start: np.ndarray, way: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Offset at which the nearest surface is one radius away, by bisection between the middle and the wall, m."""
    low, high = np.zeros(len(reach)), reach.copy()
    for _ in range(13):
        middle = (low + high) / 2
        near = surface.nearest(case).query(start + middle[:, None] * way)[0] < RADIUS
        low, high = np.where(near, low, middle), np.where(near, middle, high)
    return high
