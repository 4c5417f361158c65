"""The visible surfaces of a stretch of a tunnel, from its plan alone: wall, recesses, floor, track and furniture."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from subterra_jax.lidar3d.rolled import raise_bricks, raise_parts
from subterra_jax.lidar3d.surface import Triangles, join_surfaces
from subterra_jax.lidar3d.upright import raise_walls
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.shell import Shell, ShellLining

Colour = tuple[float, float, float]

WALL, RECESS, FLOOR = (0.66, 0.65, 0.62), (0.36, 0.355, 0.345), (0.43, 0.41, 0.38)
_STEEL, _SLEEPER, _FURNITURE = (0.40, 0.33, 0.28), (0.62, 0.61, 0.58), (0.38, 0.47, 0.53)
_LEVEL = 0.7  # cosine of the steepest floor
_SUNK, _RIM = 0.02, 0.03  # m behind the smooth wall and beyond a recess's sides, to which its points belong to it
AROUND = 6.0  # m of shell kept beyond the stretch, so that recesses at its ends are whole
_THIN = 0.08  # m; a part of the track whose half width is less is a rail: feet have 0.075


@dataclasses.dataclass(frozen=True)
class Surface:
    """A surface of one colour."""

    name: str  # name: `wall`, `recess`, `floor`, `rail`, `sleeper` or `furniture`
    triangles: Triangles  # vertices in the tunnel frame, m, and faces
    colour: Colour  # Red, green, blue, 0 to 1
    # place of each vertex on the wall unrolled, or on the floor, m, `(v, 2)`, for a texture; `None` where there
    # is none
    rolled: Float[np.ndarray, "v 2"] | None = None


def tunnel_surfaces(plan: TunnelPlan, lining: str | None, start: float, end: float) -> list[Surface]:
    """Return what a camera sees of the tunnel between two stations.

    A plan with a shell gives the bore as surveyed or drawn. One without knows its walls at the LiDAR's height alone:
    they stand upright below a level crown of an assumed height.

    Args:
        lining: Variant of its walls; `None` is the default one.
        start: First station, m; clipped to the tunnel.
        end: Last station, m; clipped to the tunnel.

    Raises:
        TunnelError: The plan does not have the lining.
    """
    start, end = max(start, 0.0), min(end, plan.length)
    name = lining or plan.default_lining
    if plan.shell is None:
        return _upright_surfaces(plan.slice(start, end - start), name)
    plan.lining(name)  # raises the error that names the tunnel
    first = plan.shell.window[0]
    shell = short_shell(plan.shell, first + start, first + end)
    _, wall, track, furniture = raise_parts(shell, name)
    wall = Triangles(wall.vertices, wall.faces[:, ::-1])  # it faces the rock; a camera stands in the air
    rolled, within, behind = _unrolled(shell, wall.vertices, name)
    centre = wall.vertices[wall.faces]
    normal = np.cross(centre[:, 1] - centre[:, 0], centre[:, 2] - centre[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    sunk = within[wall.faces].all(axis=1) & behind[wall.faces].any(axis=1)
    below = np.sin(_angles(shell, centre.mean(axis=1))) < 0.0
    level = ~sunk & below & (np.abs(normal[:, 2]) > _LEVEL)
    parts = [
        _pick("wall", wall, ~sunk & ~level, WALL, rolled),
        _pick("recess", wall, sunk, RECESS, rolled),
        _pick("floor", wall, level, FLOOR, wall.vertices[:, :2]),
        *_track_surfaces(track),
        Surface("furniture", furniture, _FURNITURE),
    ]
    return [part for part in parts if len(part.triangles.faces)]


def short_shell(shell: Shell, start: float, end: float) -> Shell:
    """Return a shell of its own for a stretch: unlike `Shell.cut` it holds nothing of the rest.

    Its triangles are not exactly those of the whole, and it is much quicker to triangulate.

    Args:
        start: First station on the shell's own axis, m.
        end: Last station, m.
    """
    station = shell.station
    keep = (station >= start - AROUND) & (station <= end + AROUND)
    zero = station[keep][0]

    def near(brick: np.ndarray) -> np.ndarray:
        if not len(brick):
            return brick
        at = station[_nearest(shell, brick[:, :3])]
        return brick[(at >= start) & (at <= end)]

    def own(lining: ShellLining) -> ShellLining:
        recess = lining.pocket
        inside = (recess[:, 0] - 0.5 * recess[:, 2] > zero + 0.2) & (
            recess[:, 0] + 0.5 * recess[:, 2] < station[keep][-1] - 0.2
        )
        moved = recess[inside] - np.array([zero, 0.0, 0.0, 0.0, 0.0])
        radius = None if lining.radius is None else lining.radius[keep]
        return ShellLining(moved, near(lining.brick), lining.seam, radius)

    return dataclasses.replace(
        shell,
        station=station[keep] - zero,
        position=shell.position[keep],
        tangent=shell.tangent[keep],
        radius=shell.radius[keep],
        track=near(shell.track),
        linings={name: own(lining) for name, lining in shell.linings.items()},
        window=(start - zero, end - zero),
    )


def _upright_surfaces(plan: TunnelPlan, lining: str) -> list[Surface]:
    _, surface = raise_walls(plan, lining)
    corner = surface.vertices[surface.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    level = np.abs(normal[:, 2]) > _LEVEL * np.linalg.norm(normal, axis=1)
    low = corner[:, :, 2].mean(axis=1) < plan.elevation.max() + plan.lidar_height
    floor = level & low
    rolled = np.column_stack([surface.vertices @ np.array([1.0, 1.0, 0.0]), surface.vertices[:, 2]])
    # A strip may be seen from either side, and each side has vertices, and so normals, of its own.
    both = join_surfaces([surface, Triangles(surface.vertices, surface.faces[:, ::-1])])
    floor, rolled = np.tile(floor, 2), np.tile(rolled, (2, 1))
    return [_pick("wall", both, ~floor, WALL, rolled), _pick("floor", both, floor, FLOOR, both.vertices[:, :2])]


def track_surfaces(shell: Shell) -> list[Surface]:
    """Return rails and sleepers of a shell within its window; none where it has no track."""
    surfaces = _track_surfaces(raise_bricks(short_shell(shell, *shell.window).track))
    return [surface for surface in surfaces if len(surface.triangles.faces)]


def _track_surfaces(track: Triangles) -> list[Surface]:
    """Return rails apart from sleepers and slabs: of a box, eight corners each, by its narrowest level side."""
    corner = track.vertices.reshape(-1, 8, 3)
    side = np.linalg.norm(corner[:, 2] - corner[:, 0], axis=1), np.linalg.norm(corner[:, 4] - corner[:, 0], axis=1)
    rail = np.repeat(np.minimum(*side) < 2.0 * _THIN, 12)
    return [
        _pick("rail", track, rail[: len(track.faces)], _STEEL, None),
        _pick("sleeper", track, ~rail[: len(track.faces)], _SLEEPER, None),
    ]


def _pick(
    name: str, surface: Triangles, mask: np.ndarray, colour: Colour, rolled: Float[np.ndarray, "v 2"] | None
) -> Surface:
    used, faces = np.unique(surface.faces[mask], return_inverse=True)
    picked = Triangles(surface.vertices[used], faces.reshape(-1, 3))
    return Surface(name, picked, colour, None if rolled is None else rolled[used])


def _nearest(shell: Shell, points: Float[np.ndarray, "k 3"]) -> Int[np.ndarray, "k"]:
    from scipy.spatial import KDTree  # half a second to import

    return np.asarray(KDTree(shell.position).query(points)[1])


def _across(shell: Shell, points: Float[np.ndarray, "k 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the nearest node, and each point's distance along, left and up from it, m."""
    node = _nearest(shell, points)
    apart = points - shell.position[node]
    along, left, up = (np.sum(apart * axis[node], axis=1) for axis in (shell.tangent, shell.left, shell.up))
    return node, along, left, up


def _angles(shell: Shell, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k"]:
    _, _, left, up = _across(shell, points)
    return np.arctan2(up, left)


def _unrolled(
    shell: Shell, points: Float[np.ndarray, "k 3"], lining: str
) -> tuple[Float[np.ndarray, "k 2"], Bool[np.ndarray, "k"], Bool[np.ndarray, "k"]]:
    """Return station and distance around from the left, m, and whether a point lies in a recess's outline and depth."""
    node, along, left, up = _across(shell, points)
    angle, own = np.arctan2(up, left), shell.linings[lining]
    radius = shell.radius if own.radius is None else own.radius
    column = np.round((angle - shell.angle[0]) * len(shell.angle) / (2.0 * np.pi)).astype(int) % len(shell.angle)
    station, behind = shell.station[node] + along, np.hypot(left, up) - radius[node, column] > _SUNK
    order, reach = np.argsort(station), np.hypot(left, up)
    within = np.zeros(len(points), bool)
    for middle, bearing, length, width, _ in own.pocket:
        first, last = np.searchsorted(station[order], [middle - 0.5 * length - _RIM, middle + 0.5 * length + _RIM])
        near = order[first:last]
        turn = (angle[near] - bearing + np.pi) % (2.0 * np.pi) - np.pi
        within[near] |= np.abs(turn) * reach[near] < 0.5 * width + _RIM
    return np.column_stack([station, angle * np.median(shell.section)]), within, behind
