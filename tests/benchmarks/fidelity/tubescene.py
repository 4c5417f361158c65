"""A whole scene folder of a tube: MJCF with a ball as robot, meshes, bore, plan and manifest; recording, truth."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.references import TRUTH_SCHEMA, Truth
from subterra_jax.host.tunnelfile import write_tunnel
from tests.benchmarks.fidelity.tube import Tube, candidate, hold
from tests.scene.bags import write_bag, write_tum

HEAD = """ply
format binary_little_endian 1.0
element vertex {vertices}
property double x
property double y
property double z
element face {faces}
property list uchar int vertex_indices
property uchar part
end_header
"""
FACE = np.dtype([("count", "u1"), ("index", "<i4", 3), ("part", "u1")])
LIDAR_HEIGHT = 0.7
_PANEL = 3.0


def write(folder: Path, tube: Tube | None = None, panels_off: float = 0.0) -> Path:
    """Writes the folder; `panels_off` moves what bodies touch away from what is seen, m."""
    tube = tube or Tube()
    made = candidate(tube, folder)
    meshes = folder / "meshes"
    meshes.mkdir(parents=True)
    made.lining.export(meshes / "lining.ply")
    made.solid.export(meshes / "solid.ply")
    made.lining.export(meshes / "lining_000.obj", digits=6)
    geoms = ['<geom name="lining_000" type="mesh" mesh="lining" contype="0" conaffinity="0"/>']
    count = {"sleepers": len(tube.sleepers), "rails": 2 * bool(len(tube.sleepers)), "wall_panels": 0}
    ends = np.linspace(0.0, tube.length, int(tube.length / _PANEL) + 1)
    for a, b in pairwise(ends):
        middle = (a + b) / 2
        floor = float(tube.floor(middle))
        half = tube.width / 2 * float(tube.scale(middle))
        size = ((b - a) / 2 + 0.02, 0.05, 1.25)
        for side, name in ((1, "left"), (-1, "right")):
            across = side * (half + 0.05 + panels_off)
            geoms.append(_box(tube, f"wall_{name}_{a:.0f}", middle, across, floor + 1.0, size, "1", 3))
            count["wall_panels"] += 1
        deck = ((b - a) / 2 + 0.02, half, 0.1)
        geoms.append(_box(tube, f"deck_{a:.0f}", middle, 0.0, floor + tube.rise - 0.1, deck, "2", 3))
    geoms += _track(tube, meshes)
    start = tube.point(2.0, 0.0, float(tube.floor(2.0)) + tube.rise + 0.3)[0]
    text = f"""<mujoco model="tube"><compiler angle="radian" meshdir="meshes"/><option timestep="0.004"/>
<asset><mesh name="lining" file="lining_000.obj" inertia="shell"/>
{'<mesh name="pads" file="pads.obj" inertia="shell"/>' if tube.track else ""}</asset>
<worldbody>{"".join(geoms)}
<body name="ball" pos="{_text(start)}"><freejoint/>
<geom name="ball" type="sphere" size="0.3" mass="20" contype="0" conaffinity="3"/></body></worldbody></mujoco>"""
    (folder / "scene.xml").write_text(text)
    (folder / "manifest.json").write_text(json.dumps({**made.manifest, "count": count}))
    np.savez(folder / "bore.npz", **vars(made.bore))
    _plan(folder / "tunnel.npz", tube)
    return folder


def record(folder: Path, tube: Tube, **settings) -> tuple[Path, Path]:
    """The tube's held-out beams as a bag of sweeps, and the poses of the sensor."""
    beams, origin = hold(tube, **{"spacing": 1.05, **settings}), np.asarray(tube.origin)  # at 1 m not all are scored
    scans, poses = [], []
    for number in np.unique(beams.scan):
        own = beams.scan == number
        stamp = float(beams.time[own][0])
        scans.append((stamp, beams.range[own, None] * beams.direction[own]))
        poses += [[stamp + late, *(beams.origin[own][0] + origin), 0, 0, 0, 1] for late in (0.0, 0.1)]
    return write_bag(folder / "held_out.bag", scans), write_tum(folder / "held_out.tum", np.array(poses))


def write_truth(folder: Path, known: Truth) -> Path:
    """A truth as the survey writes it."""
    surface = known.surface
    faces = np.zeros(len(surface.faces), FACE)
    faces["count"], faces["index"], faces["part"] = 3, surface.faces, known.part
    head = HEAD.format(vertices=len(surface.vertices), faces=len(faces)).encode()
    (folder / "truth.ply").write_bytes(
        head + (surface.vertices + known.origin).astype("<f8").tobytes() + faces.tobytes()
    )
    columns = {name: getattr(known, name).tolist() for name in ("station", "tangent", "width", "height")}
    columns |= {"position": (known.position + known.origin).tolist(), "definitions": {"parts": list(known.parts)}}
    (folder / "truth.json").write_text(json.dumps({"schema": TRUTH_SCHEMA, **columns, **known.furniture}))
    return folder


def _text(values) -> str:
    return " ".join(f"{value:.6g}" for value in np.ravel(values))


def _box(tube: Tube, name: str, station: float, left: float, up: float, size, bit: str, group: int) -> str:
    axes = np.column_stack([axis[0] for axis in tube.frames(station)[1:]])
    quaternion = Rotation.from_matrix(axes).as_quat()[[3, 0, 1, 2]]
    return (
        f'<geom name="{name}" type="box" size="{_text(size)}" pos="{_text(tube.point(station, left, up)[0])}" '
        f'quat="{_text(quaternion)}" contype="{bit}" conaffinity="0" group="{group}"/>'
    )


def _track(tube: Tube, meshes: Path) -> list[str]:
    if not tube.track:
        return []
    geoms = []
    for k, s in enumerate(tube.sleepers):
        up = float(tube.floor(s)) + tube.rise - 0.105
        geoms.append(_box(tube, f"sleeper_{k:04d}", s, 0.0, up, (0.1, 1.25, 0.105), "4", 1))
    ends = np.linspace(0.0, tube.length, int(tube.length / 1.5) + 1)
    for side, name in ((1, "left"), (-1, "right")):
        across = side * (tube.gauge + 0.073) / 2
        for k, (a, b) in enumerate(pairwise(ends)):
            base = float(tube.floor((a + b) / 2)) + tube.rise + 0.01
            for part, width, low, high in (("foot", 0.15, 0, 0.012), ("web", 0.0165, 0.012, 0.1275),
                                           ("head", 0.073, 0.1275, 0.176)):  # fmt: skip
                size, up = ((b - a) / 2, width / 2, (high - low) / 2), base + (low + high) / 2
                geoms.append(_box(tube, f"rail_{name}_{k:03d}_{part}", (a + b) / 2, across, up, size, "4", 1))
    pads: trimesh.Trimesh = candidate(tube).track.fastening_mesh
    pads.export(meshes / "pads.obj", digits=6)
    return [*geoms, '<geom name="fastenings_000" type="mesh" mesh="pads" group="1" contype="0" conaffinity="0"/>']


def _plan(path: Path, tube: Tube) -> None:
    station = np.linspace(0.0, tube.length, int(tube.length / 0.25) + 1)
    position, tangent, *_ = tube.frames(station)
    half = tube.width / 2 * tube.scale(station)
    level = tube.floor(station) + tube.rise
    walls = {
        side: tube.point(station, sign * half, level + LIDAR_HEIGHT)[:, :2]
        for side, sign in (("left", 1), ("right", -1))
    }
    facts = {"name": "tube", "provenance": "simulated", "lidar_height": LIDAR_HEIGHT, "lining": ["smooth", "pockets"]}
    fields = {
        "station": station, "centre": position[:, :2], "half_width": half,
        "tangent": tangent[:, :2] / np.linalg.norm(tangent[:, :2], axis=1, keepdims=True),
        "elevation": tube.point(station, np.zeros_like(station), level)[:, 2],
    }  # fmt: skip
    for lining in ("smooth", "pockets"):
        fields[f"furniture_{lining}"] = np.empty((0, 4))
        for side, wall in walls.items():
            fields[f"{side}_{lining}"], fields[f"{side}_station_{lining}"] = wall, station
    write_tunnel(path, facts, fields)  # in whole units, as scenes have it
