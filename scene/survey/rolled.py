"""The wall of a tunnel file as triangles: a grid of stations and angles, with its recesses cut into cells of their own.

Where recesses lie, the cells that they touch are divided by the lines of their edges. Those lines end on edges of
whole cells, which are straight, so that no gap opens.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scene.survey.mesh import Mesh, Part, grid_quads, join_meshes, pocket_mesh, split_quads

_ALIKE = 1e-6  # of a cell, within which two lines are one
_LEVEL = 0.8  # least upward part of a floor's normal


@dataclass(frozen=True)
class Sheet:
    """The wall on a grid, open along a seam that lies in the floor."""

    station: Float[np.ndarray, "n"]  # Stations of the rows, growing, m
    angle: Float[np.ndarray, "k"]  # Angles of the columns, growing over one turn from the seam to the seam, rad
    around: Float[np.ndarray, "k"]  # Arc length of the mean section from the seam, m
    vertex: Float[np.ndarray, "n k 3"]  # Survey frame, m
    middle: Float[np.ndarray, "n 3"]  # Axis at the rows, m

    def at(self, row: Float[np.ndarray, "a"], column: Float[np.ndarray, "b"]) -> Float[np.ndarray, "a b 3"]:
        """Return points at rows and columns with fractions, bilinear in between, m."""
        n, k = self.vertex.shape[:2]
        i, j = np.clip(row.astype(int), 0, n - 2), np.clip(column.astype(int), 0, k - 2)
        u, v = (row - i)[:, None, None], (column - j)[None, :, None]
        near = self.vertex[i][:, j] * (1 - v) + self.vertex[i][:, j + 1] * v
        far = self.vertex[i + 1][:, j] * (1 - v) + self.vertex[i + 1][:, j + 1] * v
        return near * (1 - u) + far * u


@dataclass(frozen=True)
class Recess:
    """A rectangle of the wall that is sunk, by rows and columns with fractions."""

    row: tuple[float, float]
    column: tuple[float, float]
    outward: Float[np.ndarray, "3"]  # Way from mouth to back, m


def place_recesses(sheet: Sheet, pocket: Float[np.ndarray, "p 5"]) -> list[Recess]:
    """Return recesses by station and angle of the middle, length, width and depth, m and rad.

    Raises:
        ValueError: A recess reaches across the seam.
    """
    girth = sheet.around[-1]
    around = np.interp(np.mod(pocket[:, 1] - sheet.angle[0], 2 * np.pi) + sheet.angle[0], sheet.angle, sheet.around)
    low, high = around - 0.5 * pocket[:, 3], around + 0.5 * pocket[:, 3]
    if ((low <= 0.0) | (high >= girth)).any():
        at = pocket[int(np.argmax((low <= 0.0) | (high >= girth))), 0]
        raise ValueError(f"the recess at station {at:.2f} m reaches across the seam of the wall")
    rows = np.arange(len(sheet.station), dtype=float)
    columns = np.arange(len(sheet.angle), dtype=float)
    ends = pocket[:, :1] + 0.5 * pocket[:, 2:3] * [-1.0, 1.0]
    row = np.interp(ends, sheet.station, rows)
    column = np.interp(np.column_stack([low, high]), sheet.around, columns)
    reach = max(1, len(sheet.angle) // 72)
    centre = np.interp(around, sheet.around, columns)
    middle = np.rint(np.interp(pocket[:, 0], sheet.station, rows)).astype(int)
    recesses = []
    for k in range(len(pocket)):
        if ends[k, 0] < sheet.station[0] or ends[k, 1] > sheet.station[-1]:
            continue
        beside = np.clip(centre[k] + reach * np.array([-1, 1]), 0, columns[-1])
        first, last = sheet.at(rows[middle[k] : middle[k] + 1], beside)[0]
        i = min(max(middle[k], 1), len(sheet.middle) - 2)
        normal = np.cross(last - first, sheet.middle[i + 1] - sheet.middle[i - 1])
        outward = pocket[k, 4] * normal / np.linalg.norm(normal)
        recesses.append(Recess((row[k, 0], row[k, 1]), (column[k, 0], column[k, 1]), outward))
    return recesses


def wall_mesh(sheet: Sheet, recesses: list[Recess]) -> Mesh:
    """Return wall, floor and recesses, with normals towards the air."""
    n, k = sheet.vertex.shape[:2]
    keep = np.ones((n - 1, k - 1), bool)
    parts = []
    for block, inside in _blocks(recesses, (n - 1, k - 1)):
        keep[block[0] : block[1], block[2] : block[3]] = False
        parts.append(_block_mesh(sheet, block, inside))
    quads = grid_quads(np.arange(n * k).reshape(n, k))[keep]
    station = np.broadcast_to(0.5 * (sheet.station[1:] + sheet.station[:-1])[:, None], keep.shape)[keep]
    faces = split_quads(quads)
    plain = Mesh(sheet.vertex.reshape(-1, 3), faces, np.zeros(len(faces), np.uint8), station.repeat(2))
    whole = join_meshes([plain, *parts])
    corner = whole.vertices[whole.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    up = normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    centre = np.interp(whole.station, sheet.station, sheet.middle[:, 2])
    floor = (whole.part == Part.LINING) & (up > _LEVEL) & (corner[..., 2].mean(axis=1) < centre)
    return Mesh(whole.vertices, whole.faces, np.where(floor, np.uint8(Part.FLOOR), whole.part), whole.station)


Block = tuple[int, int, int, int]  # first row and the one after the last, first column and the one after the last


def _blocks(recesses: list[Recess], most: tuple[int, int]) -> list[tuple[Block, list[Recess]]]:
    """Return blocks of cells that share none, each with the recesses in it."""
    done: list[tuple[Block, list[Recess]]] = []
    near: list[tuple[Block, list[Recess]]] = []  # those that a later recess may share a cell with
    for recess in sorted(recesses, key=lambda one: one.row[0]):
        block, inside = _cells(recess, most), [recess]
        done += [one for one in near if one[0][1] <= block[0]]
        near = [one for one in near if one[0][1] > block[0]]
        while shared := [one for one in near if _share(block, one[0])]:
            near = [one for one in near if not _share(block, one[0])]
            edges = np.array([block, *(one[0] for one in shared)])
            low, high = edges.min(axis=0), edges.max(axis=0)
            block = (int(low[0]), int(high[1]), int(low[2]), int(high[3]))
            inside = [*inside, *(each for one in shared for each in one[1])]
        near.append((block, inside))
    return done + near


def _cells(recess: Recess, most: tuple[int, int]) -> Block:
    (r0, r1), (c0, c1) = recess.row, recess.column
    return (
        max(int(np.floor(r0)), 0), min(int(np.ceil(r1)), most[0]),
        max(int(np.floor(c0)), 0), min(int(np.ceil(c1)), most[1]),
    )  # fmt: skip


def _share(a: Block, b: Block) -> bool:
    return a[0] < b[1] and b[0] < a[1] and a[2] < b[3] and b[2] < a[3]


def _block_mesh(sheet: Sheet, block: Block, recesses: list[Recess]) -> Mesh:
    """Return the cells of a block, divided by the edges of its recesses, which are sunk."""
    row = _lines(block[0], block[1], [edge for recess in recesses for edge in recess.row])
    column = _lines(block[2], block[3], [edge for recess in recesses for edge in recess.column])
    vertex = sheet.at(row, column)
    across, along = 0.5 * (column[1:] + column[:-1]), 0.5 * (row[1:] + row[:-1])
    station = np.interp(along, np.arange(len(sheet.station)), sheet.station)
    keep, parts = np.ones((len(along), len(across)), bool), []
    for recess in recesses:
        rows = np.flatnonzero((along > recess.row[0]) & (along < recess.row[1]))
        columns = np.flatnonzero((across > recess.column[0]) & (across < recess.column[1]))
        if not len(rows) or not len(columns):
            continue
        keep[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = False
        mouth = vertex[rows[0] : rows[-1] + 2, columns[0] : columns[-1] + 2]
        parts.append(pocket_mesh(mouth, recess.outward, float(station[rows].mean())))
    quads = grid_quads(np.arange(len(row) * len(column)).reshape(len(row), len(column)))[keep]
    faces = split_quads(quads)
    at = np.broadcast_to(station[:, None], keep.shape)[keep].repeat(2)
    plain = Mesh(vertex.reshape(-1, 3), faces, np.zeros(len(faces), np.uint8), at)
    return join_meshes([plain, *parts])


def _lines(first: int, last: int, edges: list[float]) -> Float[np.ndarray, "l"]:
    """Return whole lines from first to last and the edges between them, without those that are alike."""
    lines = np.sort(np.concatenate([np.arange(first, last + 1.0), edges]))
    return lines[np.concatenate([[True], np.diff(lines) > _ALIKE])]
