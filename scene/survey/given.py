"""A true bore from a tunnel file, as `scene.build` or `st.tunnel.save_tunnel` wrote it, and its truth.

The reader shares no code with what wrote the file; docs/formats.md has the fields.
"""

import hashlib
import zipfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline

from scene.survey.alignment import MARGIN, Alignment, Frames
from scene.survey.config import SurveyConfig
from scene.survey.mesh import EMPTY, Mesh, Part, box_mesh, join_meshes
from scene.survey.rolled import Recess, Sheet, place_recesses, wall_mesh
from scene.survey.write import DEFINITIONS, TRUTH_STEP, rounded

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


_POCKET = (0.45, 0.35)  # m: recesses up to this size, along and around, and up to this depth are pockets, others niches
_LEVELS = 200  # heights at which the width of a section is looked for
_HEAD = 0.03  # m below the highest middle of a rail's box, within which a box is a head
_ABOVE_FLOOR, _OF_CROWN = 0.05, 0.5  # m above the floor and below the crown, between which walls are walls


def describe_given(bore: GivenBore, config: SurveyConfig) -> dict[str, Any]:
    """Return the content of `truth.json`, per docs/formats.md."""
    station = np.arange(0.0, bore.alignment.length + 1e-9, TRUTH_STEP)
    frames = bore.alignment.frames(station)
    width, height, middle = measure_sections(bore, station)
    sleepers = [k for k in range(bore.track) if bore.part_of(k) is Part.SLEEPER]
    tops = bore.brick[sleepers, :3] + bore.brick[sleepers, 9:12]
    pockets, niches = _describe_recesses(bore)
    settings = {k: v for k, v in asdict(config).items() if k not in ("out", "truth", "truth_file", "lining")}
    return {
        "schema": "subterra.truth/1",
        "provenance": "simulated",
        "section_type": "given",
        "seed": config.seed,
        "config": settings | {"truth_file": {"tunnel": bore.name, "lining": bore.lining, "sha256": bore.digest}},
        "definitions": {name: DEFINITIONS[name] for name in ("frame", "width", "height", "middle", "angle")}
        | {
            "position": "middle of the mean section: half its width, half its height; station is arc length along it",
            "width_smooth": "median of width along the bore; height_smooth of height",
            "pockets.depth": "along the normal of the wall at the pocket's middle",
            "things": "boxes and niches by station, left of the axis and above the floor",
        },
        "length": bore.alignment.length,
        "station": rounded(station),
        "position": rounded(frames.position),
        "tangent": rounded(frames.tangent, 9),
        "width": rounded(width),
        "height": rounded(height),
        "width_smooth": rounded(np.full_like(width, np.median(width))),
        "height_smooth": rounded(np.full_like(height, np.median(height))),
        "middle": rounded(middle),
        "crossfall": 0.0,
        "aside": rounded(np.zeros_like(station)),
        "tracks": [0.0] if bore.track else [],
        "things": [*_describe_boxes(bore), *niches],
        "cutting": None,
        "dark": None,
        "strays": bore.strays,
        "rings": {"width": bore.ring_pitch, "station": rounded(bore.at(bore.ring_joint))},
        "pockets": pockets,
        "nails": {"count": 0},
        "sleepers": {
            "station": rounded(bore.at(bore.box_stations()[sleepers])),
            "position": rounded(tops),
            "top_above_floor": _rise(bore, tops, sleepers),
        },
        "rails": {"gauge": _gauge(bore)},
    }


def measure_sections(
    bore: GivenBore, station: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n 2"]]:
    """Return width, height and the middle of the wall, recesses left out, at stations by arc length, m."""
    rows, n = bore.section.station, len(bore.sheet.station)
    frames = bore.alignment.frames(rows)
    offset = bore.sheet.vertex - frames.position[:, None]
    y = np.einsum("nki,ni->nk", offset, frames.lateral)
    z = np.einsum("nki,ni->nk", offset, frames.up)
    width, across = np.empty(n), np.empty(n)
    for k in range(n):
        top = int(np.argmax(z[k]))
        level = np.linspace(z[k].min() + _ABOVE_FLOOR, z[k, top] - _OF_CROWN, _LEVELS)
        # From the seam in the floor up the left wall to the crown, and down the right one.
        left = np.interp(level, np.maximum.accumulate(z[k, : top + 1]), y[k, : top + 1])
        right = np.interp(level, np.maximum.accumulate(z[k, : top - 1 : -1]), y[k, : top - 1 : -1])
        widest = int(np.argmax(left - right))
        width[k], across[k] = left[widest] - right[widest], 0.5 * (left[widest] + right[widest])
    columns = (width, bore.section.value, across, bore.section.middle)
    out = [np.interp(station, rows, values) for values in columns]
    return out[0], out[1], np.column_stack(out[2:])


def _describe_recesses(bore: GivenBore) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return pockets and niches; a niche's box reaches from its mouth into the wall."""
    pockets, niches = [], []
    at = bore.at(bore.pocket[:, 0])
    frames = bore.alignment.frames(at)
    half = 0.5 * bore.section.height(at)
    for k, (recess, row) in enumerate(zip(bore.recesses, bore.pocket, strict=True)):
        centre = bore.sheet.at(np.array([np.mean(recess.row)]), np.array([np.mean(recess.column)]))[0, 0]
        left, above = frames.lateral[k] @ (centre - frames.position[k]), frames.up[k] @ (centre - frames.position[k])
        outward = recess.outward / row[4]
        if row[2] <= _POCKET[0] and row[3] <= _POCKET[0] and row[4] <= _POCKET[1]:
            pockets.append({
                "station": round(float(at[k]), 6), "angle": round(float(np.arctan2(above, left)), 6),
                "above_floor": round(float(above + half[k]), 6), "position": rounded(centre),
                "outward": rounded(outward, 9), "length": round(float(row[2]), 6),
                "depth": round(float(row[4]), 6), "width": round(float(row[3]), 6), "open": True, "nail": False,
            })  # fmt: skip
            continue
        sides = sorted((left, left + np.copysign(row[4], left)))
        box = {"start": at[k] - 0.5 * row[2], "end": at[k] + 0.5 * row[2], "right": sides[0], "left": sides[1]}
        box |= {"low": above + half[k] - 0.5 * row[3], "high": above + half[k] + 0.5 * row[3]}
        niches.append({"kind": "niche", **{name: round(float(value), 6) for name, value in box.items()}})
    return sorted(pockets, key=lambda pocket: float(pocket["station"])), niches


def _describe_boxes(bore: GivenBore) -> list[dict[str, Any]]:
    """Return the boxes that are no track."""
    out = []
    at = bore.at(bore.box_stations())
    frames, half = bore.alignment.frames(at), 0.5 * bore.section.height(at)
    for k in range(bore.track, len(bore.brick)):
        corner = box_mesh(bore.brick[k, :3], bore.brick[k, 3:12].reshape(3, 3), bore.brick[k, 12], Part.THING, 0.0)
        offset = corner.vertices - frames.position[k]
        along, left, above = (offset @ axis for axis in (frames.tangent[k], frames.lateral[k], frames.up[k]))
        box = {"start": at[k] + along.min(), "end": at[k] + along.max(), "right": left.min(), "left": left.max()}
        box |= {"low": above.min() + half[k], "high": above.max() + half[k]}
        out.append({"kind": "furniture", **{name: round(float(value), 6) for name, value in box.items()}})
    return out


def _rise(bore: GivenBore, tops: Float[np.ndarray, "k 3"], sleepers: list[int]) -> float:
    """Return the median height of the sleepers' tops above the floor, m; 0 without sleepers."""
    if not sleepers:
        return 0.0
    at = bore.at(bore.box_stations()[sleepers])
    frames = bore.alignment.frames(at)
    above = np.einsum("ki,ki->k", tops - frames.position, frames.up) + 0.5 * bore.section.height(at)
    return round(float(np.median(above)), 6)


def _gauge(bore: GivenBore) -> float | None:
    """Return the distance of the inner faces of the rails' heads, their highest boxes, m; `None` without rails."""
    rails = [k for k in range(bore.track) if bore.part_of(k) is Part.RAIL]
    if not rails:
        return None
    frames = bore.alignment.frames(bore.at(bore.box_stations()[rails]))
    offset = bore.brick[rails, :3] - frames.position
    left, above = np.einsum("ki,ki->k", offset, frames.lateral), np.einsum("ki,ki->k", offset, frames.up)
    heads = above > above.max() - _HEAD
    half = np.linalg.norm(bore.brick[rails, 6:9], axis=1)[heads]
    sides = [
        float(np.median(left[heads][side * left[heads] > 0] - side * half[side * left[heads] > 0])) for side in (1, -1)
    ]
    return round(sides[0] - sides[1], 6)
