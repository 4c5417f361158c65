"""Where recesses sit on the wall: its points, its normals, and the boxes of recesses sunk square into it."""

import numpy as np
from jaxtyping import Float, Int

from scene.bore import Bore

_LID_OVERLAP = 0.05  # how far a box reaches into the air, so that a union leaves no film


def on_wall(bore: Bore, station: Float[np.ndarray, " k"], angle: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k 3"]:
    """Points of the smooth wall, bilinear between the sections' points, m."""
    n, m = bore.radius.shape
    row = np.clip(station / (bore.station[1] - bore.station[0]), 0, n - 1)
    column = (angle - bore.angle[0]) / (2 * np.pi) * m
    r, c = np.minimum(row.astype(int), n - 2), np.floor(column).astype(int)
    along, across = (row - r)[:, None], (column - c)[:, None]
    c, d = c % m, (c + 1) % m
    near = _point(bore, r, c) * (1 - across) + _point(bore, r, d) * across
    far = _point(bore, r + 1, c) * (1 - across) + _point(bore, r + 1, d) * across
    return near * (1 - along) + far * along


def _point(bore: Bore, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    radius, angle = bore.radius[row, column, None], bore.angle[column, None]
    return bore.position[row] + radius * (np.cos(angle) * bore.lateral[row] + np.sin(angle) * bore.up[row])


def wall_normals(bore: Bore, pocket: Int[np.ndarray, " r"]) -> Float[np.ndarray, "r 3"]:
    """Outward unit normals of the wall at some pockets, over an arc of about 5°."""
    m = len(bore.angle)
    row = np.rint(bore.pocket["station"][pocket] / (bore.station[1] - bore.station[0])).astype(int)
    row = np.clip(row, 0, len(bore.station) - 1)
    turn = (bore.pocket["angle"][pocket] - bore.angle[0]) / (2 * np.pi) * m
    column, reach = np.rint(turn).astype(int), max(1, m // 144)
    normal = np.cross(
        _point(bore, row, (column + reach) % m) - _point(bore, row, (column - reach) % m), bore.tangent[row]
    )
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def recess_boxes(bore: Bore, pocket: Int[np.ndarray, " r"]) -> list[Float[np.ndarray, "8 3"]]:
    """Corners of some pockets as boxes square to the wall they are sunk into, m."""
    rows = bore.pocket[pocket]
    centre, outward = on_wall(bore, rows["station"], rows["angle"]), wall_normals(bore, pocket)
    around = np.cross(outward, bore.axis.at(rows["station"]).tangent)
    along = np.cross(around, outward)
    return [
        np.array(
            [
                centre[k] + i * rows["length"][k] / 2 * along[k] + j * rows["width"][k] / 2 * around[k] + d * outward[k]
                for i in (-1, 1)
                for j in (-1, 1)
                for d in (-_LID_OVERLAP, float(rows["depth"][k]))
            ]
        )
        for k in range(len(rows))
    ]
