"""A true bore from a tunnel file: what `scene.build` or `st.tunnel.save_tunnel` wrote, surveyed as it stands.

The reader shares no code with what wrote the file; docs/formats.md has the fields.
"""

import hashlib
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline

from scene.survey.alignment import MARGIN, Alignment, Frames
from scene.survey.mesh import EMPTY, Mesh, Part, box_mesh, join_meshes
from scene.survey.rolled import Recess, Sheet, place_recesses, wall_mesh

SCHEMA = "subterra.tunnel/3"
_RAIL = 0.1  # m, half the width of what is no wider than a rail
_NEAR = 1e-6  # m


@dataclass(frozen=True)
class Heights:
    """Height of the bore by station, where a drawn bore has its section."""

    station: Float[np.ndarray, "n"]  # m
    value: Float[np.ndarray, "n"]  # From floor to crown on the axis, m
    middle: Float[np.ndarray, "n"]  # Of the height above the centreline, m

    def height(self, station: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
        """Return the height from the floor to the crown on the axis, m."""
        return np.interp(station, self.station, self.value)


@dataclass(frozen=True)
class GivenBore:
    """A bore of a tunnel file; stations are arc length along the middle of its mean section."""

    name: str  # Name of the tunnel
    lining: str  # Variant of its walls
    digest: str  # SHA-256 of the file
    alignment: Alignment  # Its centreline
    section: Heights  # Its height
    sheet: Sheet  # Its wall, whose stations are those of the file
    pocket: Float[np.ndarray, "p 5"]  # Recesses: station (of the file) and angle of the middle, length, width, depth
    recesses: list[Recess]  # The same on the wall
    brick: Float[np.ndarray, "b 13"]  # Boxes: centre, half edges along, left and up, taper, m
    track: int  # Number of the boxes, from the first, that are track
    ring_pitch: float  # Ring length on the drawings, m; 0 without rings
    ring_joint: Float[np.ndarray, "j"]  # Ring joints as built, stations of the file, m; empty where not known
    strays: float = 0.0

    def mesh(self) -> Mesh:
        """Return every surface that a ray can meet."""
        meshes = [wall_mesh(self.sheet, self.recesses), *self._boxes()]
        at = np.asarray(self.at(self.sheet.station))
        mesh = join_meshes(meshes)
        station = np.interp(mesh.station, self.sheet.station, at)
        return replace(mesh, vertices=np.round(mesh.vertices, 6), station=station)

    def at(self, station: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
        """Return stations of the file as arc length, m."""
        return np.interp(station, self.sheet.station, self.section.station)

    def part_of(self, row: int) -> Part:
        """Return what a box is: a sleeper tapers, a rail is narrow, other parts of the track count as floor."""
        if row >= self.track:
            return Part.THING
        if self.brick[row, 12] != 0.0:
            return Part.SLEEPER
        return Part.RAIL if np.linalg.norm(self.brick[row, 6:9]) < _RAIL else Part.FLOOR

    def box_stations(self) -> Float[np.ndarray, "b"]:
        """Return the stations, of the file, of the middles of the boxes, m."""
        middle, tangent = self.sheet.middle, np.gradient(self.sheet.middle, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        rows = np.array([int(np.argmin(((middle - centre) ** 2).sum(axis=1))) for centre in self.brick[:, :3]], int)
        return self.sheet.station[rows] + np.einsum("bi,bi->b", self.brick[:, :3] - middle[rows], tangent[rows])

    def _boxes(self) -> list[Mesh]:
        station = self.box_stations()
        half = self.brick[:, 3:12].reshape(-1, 3, 3)
        rows = enumerate(zip(self.brick, half, station, strict=True))
        return [EMPTY, *(box_mesh(b[:3], h, float(b[12]), self.part_of(k), float(s)) for k, (b, h, s) in rows)]


def read_given(path: Path, lining: str, length: float) -> GivenBore:
    """Reads the first `length` m of a `tunnel.npz` with its bore in three dimensions.

    An empty `lining` takes `pockets`, or the first where there is none of that name. Raises `ValueError` where the file
    is no such file, holds no bore in three dimensions, or not this lining or length.
    """
    fields = _read(path)
    names = [str(name) for name in fields["lining"]]
    chosen = lining or ("pockets" if "pockets" in names else names[0])
    if chosen not in names:
        raise ValueError(f"{path}: there is no lining {chosen!r}; there are {', '.join(names)}")
    station = fields["station"].astype(float)
    if length > station[-1] + _NEAR:
        raise ValueError(f"length must be at most {station[-1]:g} m for {path}, got {length:g}")
    rows = int(np.searchsorted(station, length + _NEAR))
    own = f"shell_radius_{chosen}"
    radius = fields[own if own in fields else "shell_radius"][:rows]
    level = np.sqrt(1.0 - fields["shell_rise"][:rows, None] ** 2)
    tangent = np.column_stack([level * fields["tangent"][:rows], fields["shell_rise"][:rows]])
    axis = np.column_stack([fields["centre"], fields["elevation"] + fields["shell_height"]])[:rows]
    sheet = _roll_up(station[:rows], axis, tangent, fields["shell_angle"], radius, fields["shell_section"],
                     float(fields[f"shell_seam_{chosen}"]))  # fmt: skip
    pocket = fields[f"shell_pocket_{chosen}"].astype(float)
    pocket = pocket[pocket[:, 0] + 0.5 * pocket[:, 2] < station[rows - 1]]
    brick = np.concatenate([fields["shell_track"], fields[f"shell_brick_{chosen}"]]).astype(float)
    alignment, heights = _centre(axis, tangent, fields["shell_angle"], radius, fields["shell_section"])
    recesses = place_recesses(sheet, pocket)
    joint = fields["ring_joint"].astype(float) if "ring_joint" in fields else np.empty(0)
    bore = GivenBore(
        str(fields["name"]), chosen, hashlib.sha256(path.read_bytes()).hexdigest(), alignment, heights, sheet, pocket,
        recesses, brick, len(fields["shell_track"]), float(fields.get("ring_pitch", 0.0)),
        joint[joint < station[rows - 1]],
    )  # fmt: skip
    inside = bore.box_stations() < station[rows - 1] if len(brick) else np.empty(0, bool)
    return replace(bore, brick=brick[inside], track=int(inside[: bore.track].sum()))


def _read(path: Path) -> dict[str, np.ndarray]:
    """Return the fields of a tunnel file that holds a bore in three dimensions."""
    try:
        with np.load(path, allow_pickle=False) as data:
            fields = {name: data[name] for name in data.files}
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such tunnel file") from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: not a readable .npz archive") from error
    fields = {name: _values(fields, name) for name in fields}
    found = str(fields["schema"]) if "schema" in fields else "missing"
    if found != SCHEMA or "shell_radius" not in fields:
        why = "it is planar" if found == SCHEMA else f"schema {found}; {SCHEMA} does"
        raise ValueError(
            f"{path}: holds no bore in three dimensions ({why}): build its scene again, or save a tunnel of the open "
            "world with st.tunnel.save_tunnel"
        )
    wanted = ["name", "lining", "station", "centre", "tangent", "elevation", "shell_height", "shell_rise"]
    wanted += ["shell_angle", "shell_section", "shell_radius", "shell_track"]
    wanted += [f"shell_{part}_{name}" for part in ("pocket", "brick", "seam") for name in fields.get("lining", [])]
    for name in wanted:
        if name not in fields:
            raise ValueError(f"{path}: field {name!r} is missing")
        if fields[name].dtype.kind in "fiu" and not np.isfinite(fields[name]).all():
            raise ValueError(f"{path}: field {name!r} has a value that is not finite")
    return fields


def _values(fields: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Return a field, its whole numbers summed up along the first axis and in their unit."""
    unit = fields.get("shell_unit" if name.startswith("shell_radius") else "unit")
    if unit is None or not fields[name].ndim or fields[name].dtype.kind != "i":
        return fields[name]
    return float(unit) * fields[name].cumsum(axis=0, dtype=np.int64)


def _roll_up(
    station: Float[np.ndarray, "n"],
    axis: Float[np.ndarray, "n 3"],
    tangent: Float[np.ndarray, "n 3"],
    angle: Float[np.ndarray, "m"],
    radius: Float[np.ndarray, "n m"],
    section: Float[np.ndarray, "m"],
    seam: float,
) -> Sheet:
    """Return the wall, cut open at the column next to the seam."""
    m = len(angle)
    first = int(np.argmin(np.abs(np.angle(np.exp(1j * (angle - seam))))))
    columns = (first + np.arange(m + 1)) % m
    turned = angle[columns] + 2 * np.pi * (first + np.arange(m + 1) >= m)
    left = np.column_stack([-tangent[:, 1], tangent[:, 0], np.zeros(len(axis))])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    frames = Frames(axis, tangent, left, np.cross(tangent, left))
    reach = radius[:, columns]
    vertex = frames.point(reach * np.cos(turned), reach * np.sin(turned))
    outline = section[columns, None] * np.column_stack([np.cos(turned), np.sin(turned)])
    around = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    return Sheet(station, turned, around, vertex, axis)


def _centre(
    axis: Float[np.ndarray, "n 3"],
    tangent: Float[np.ndarray, "n 3"],
    angle: Float[np.ndarray, "m"],
    radius: Float[np.ndarray, "n m"],
    section: Float[np.ndarray, "m"],
) -> tuple[Alignment, Heights]:
    """Return the line through the middle of the mean section, by arc length, and the heights along it."""
    y, z = section * np.cos(angle), section * np.sin(angle)
    across = 0.5 * float(y.max() + y.min())
    above = 0.5 * sum(_wall_over(y[None], z[None], across, side)[0] for side in (1, -1))
    left = np.column_stack([-tangent[:, 1], tangent[:, 0], np.zeros(len(axis))])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    line = axis + across * left + above * np.cross(tangent, left)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    rows, turns = radius * np.cos(angle), radius * np.sin(angle)
    crown, floor = (_wall_over(rows, turns, across, side) for side in (1, -1))
    return lay_through(arc, line, tangent), Heights(arc, crown - floor, 0.5 * (crown + floor) - above)


def _wall_over(
    y: Float[np.ndarray, "n m"], z: Float[np.ndarray, "n m"], at: float, side: int
) -> Float[np.ndarray, "n"]:
    """Return the height of crown (`side` 1) or floor (-1) of sections at one lateral, m."""
    out = np.empty(len(y))
    for k in range(len(y)):
        half = side * z[k] > 0.0
        order = np.argsort(y[k, half])
        out[k] = np.interp(at, y[k, half][order], z[k, half][order])
    return out


def lay_through(
    arc: Float[np.ndarray, "n"], line: Float[np.ndarray, "n 3"], tangent: Float[np.ndarray, "n 3"]
) -> Alignment:
    """Return the alignment through points by arc length, m; beyond its ends it runs on straight."""
    ends = np.array([arc[0] - MARGIN, arc[-1] + MARGIN])
    s = np.concatenate([ends[:1], arc, ends[1:]])
    t = np.concatenate([tangent[:1], tangent, tangent[-1:]])
    points = np.concatenate([line[:1] - MARGIN * tangent[:1], line, line[-1:] + MARGIN * tangent[-1:]])
    heading, slope = np.unwrap(np.arctan2(t[:, 1], t[:, 0])), np.arcsin(np.clip(t[:, 2], -1.0, 1.0))

    def curve(values: np.ndarray) -> CubicHermiteSpline:
        rate = np.gradient(values, s, axis=0)
        rate[[0, 1, -2, -1]] = 0.0
        return CubicHermiteSpline(s, values, rate)

    return Alignment(float(arc[-1]), CubicHermiteSpline(s, points, t), curve(heading), curve(slope))
