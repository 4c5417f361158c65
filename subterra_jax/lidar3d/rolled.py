"""The surface of a shell: its wall unrolled, triangulated with its recesses, and rolled up again."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.unrolled import (
    BAND,
    Grid,
    Sections,
    close_mouths,
    corners,
    delaunay,
    open_mouths,
    rectangles,
    roll_up,
    triangulate,
    unroll,
)
from subterra_jax.lidar3d.surface import BOX_FACES, Axis, Triangles, join_surfaces
from subterra_jax.tunnel.shell import Shell, ShellLining, brick_corners

_NEAR, _WIDE = 2, 3  # steps of the grid
_AROUND_CUT = 4.0  # of wall beyond a cut that is triangulated, m; further away no triangle depends on it


def raise_shell(shell: Shell, lining: str) -> tuple[Axis, Triangles]:
    """Return the axis and the surface of one variant: wall with recesses, track, furniture.

    Args:
        lining: Name of the variant.

    Raises:
        TunnelError: The shell does not have the variant.
    """
    axis, *parts = raise_parts(shell, lining)
    return axis, join_surfaces(parts)


def raise_parts(shell: Shell, lining: str) -> tuple[Axis, Triangles, Triangles, Triangles]:
    """Return the axis and, apart, the wall with its recesses, the track and the furniture.

    Args:
        shell: As for `raise_shell`.
        lining: As for `raise_shell`.

    Raises:
        TunnelError: As for `raise_shell`.
    """
    if lining not in shell.linings:
        raise TunnelError(f"the shell has no lining {lining!r}; it has {', '.join(shell.linings)}")
    own = shell.linings[lining]
    if own.radius is not None:
        shell = replace(shell, radius=own.radius)
    wall = _raise_wall(shell, own)
    return _cut_axis(shell), wall, raise_bricks(shell.track), raise_bricks(own.brick)


def raise_bricks(brick: Float[np.ndarray, "k 13"]) -> Triangles:
    """Return bricks as triangles, eight vertices and twelve faces each."""
    first = 8 * np.arange(len(brick))
    return Triangles(brick_corners(brick).reshape(-1, 3), (first[:, None, None] + BOX_FACES).reshape(-1, 3))


def _cut_axis(shell: Shell) -> Axis:
    """Return the axis within the window, stations from 0."""
    start, end = shell.window[0], min(shell.window[1], shell.station[-1])
    if start == 0.0 and end == shell.station[-1]:
        return Axis(shell.station, shell.position, shell.tangent)
    step = shell.station[1] - shell.station[0]
    station = np.linspace(start, end, max(2, round((end - start) / step) + 1))
    position, tangent = (
        np.stack([np.interp(station, shell.station, column) for column in values.T], axis=-1)
        for values in (shell.position, shell.tangent)
    )
    return Axis(station - start, position, tangent / np.linalg.norm(tangent, axis=1, keepdims=True))


def _raise_wall(shell: Shell, lining: ShellLining) -> Triangles:
    sections = Sections(
        shell.station, shell.position, shell.tangent, shell.left, shell.up, shell.angle, shell.radius
    )  # fmt: skip
    plane, length = unroll(shell.angle, shell.section, lining.seam), float(shell.station[-1])
    boxes, apart = rectangles(plane, length, lining.pocket, BAND * shell.spacing[1])
    fold = np.sort(plane.to_around(corners(shell.angle, shell.section)))
    near = (shell.window[0] - _AROUND_CUT, shell.window[1] + _AROUND_CUT)
    whole = not apart.all()
    if whole:
        near = (-np.inf, np.inf)  # the union needs the whole, closed at both mouths
    chosen = apart & (boxes[:, 2] > near[0]) & (boxes[:, 3] < near[1])
    sheet = triangulate(
        plane, length, fold, boxes[chosen], shell.spacing, near, lambda grid: _faces(grid, plane.girth, length)
    )
    vertices, faces = roll_up(sections, plane, sheet, lining.pocket[chosen])
    if not whole:
        return Triangles(vertices, faces)
    return _sink(sections, *close_mouths(sections, sheet, vertices, faces), lining.pocket[~apart])


def _faces(grid: Grid, girth: float, length: float) -> Int[np.ndarray, "f 3"]:
    """Return Delaunay's triangles; those of the plain grid, which are known, need not be looked for.

    Around what is not of the grid, and where a point of it is missing, triangles are looked for among the points
    within `_WIDE` steps of those that may be affected, which lie within `_NEAR` steps.
    """
    u, s, node, shape = grid
    point = np.full(shape, -1)
    there = np.flatnonzero(node >= 0)
    point.ravel()[node[there]] = there
    foreign = np.flatnonzero(node < 0)
    rows = np.clip(np.rint(s[foreign] / length * (shape[0] - 1)).astype(int), 0, shape[0] - 1)
    odd = point < 0
    odd[rows, np.floor(u[foreign] / girth * shape[1]).astype(int) % shape[1]] = True
    near = _grown(odd, _NEAR)
    patch = np.sort(np.concatenate([foreign, point[_grown(near, _WIDE) & (point >= 0)]]))
    if len(patch) > 0.5 * len(u):
        return delaunay(u, s, girth)
    found = patch[delaunay(u[patch], s[patch], girth)] if len(patch) else np.empty((0, 3), int)
    affected = np.ones(len(u), bool)
    affected[point[~near]] = False
    return np.concatenate([_plain(point, ~near), found[affected[found].any(axis=1)]])


def _grown(mask: Bool[np.ndarray, "r c"], steps: int) -> Bool[np.ndarray, "r c"]:
    """Return a mask grown by some rows and columns to either side; columns go round."""
    from scipy.ndimage import maximum_filter  # planar tasks do not need it

    return maximum_filter(mask, 2 * steps + 1, mode=("constant", "wrap"))


def _plain(point: Int[np.ndarray, "r c"], free: Bool[np.ndarray, "r c"]) -> Int[np.ndarray, "f 3"]:
    """Return the triangles between the rows of a plain grid, of free points alone."""
    parts = []
    for first in (0, 1):
        # The row above an even one lies half a step ahead of it, that above an odd one half a step behind.
        low, high = point[first:-1:2], point[first + 1 :: 2]
        ahead = high if first == 0 else np.roll(high, -1, axis=1)
        parts += [
            np.stack([low, np.roll(low, -1, axis=1), ahead], axis=-1).reshape(-1, 3),
            np.stack([ahead, np.roll(ahead, 1, axis=1), low], axis=-1).reshape(-1, 3),
        ]
    faces = np.concatenate(parts)
    known = np.zeros(point.max() + 2, bool)  # the last is that of a missing point, whose number is -1
    known[point[free]] = True
    return faces[known[faces].all(axis=1)]


def _sink(sections: Sections, vertices: np.ndarray, faces: np.ndarray, pocket: Float[np.ndarray, "r 5"]) -> Triangles:
    """Return a wall with recesses that touch others, the seam or a mouth, as the union of the air with their boxes."""
    from manifold3d import Manifold, Mesh64, OpType  # planar tasks do not need it

    solid = Manifold(Mesh64(vertices, faces.astype(np.uint64)))
    columns = sections.tangent.T
    tangent = np.stack([np.interp(pocket[:, 0], sections.station, column) for column in columns], axis=-1)
    recesses = [Manifold.hull_points(box) for box in sections.recess_boxes(pocket, tangent)]
    whole = solid + Manifold.batch_boolean(recesses, OpType.Add)
    mesh = max(whole.decompose(), key=lambda part: part.volume()).to_mesh64()
    vertices = np.array(mesh.vert_properties[:, :3])
    return Triangles(vertices, open_mouths(sections, vertices, np.array(mesh.tri_verts, np.int64)))
