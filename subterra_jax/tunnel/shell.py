"""The bore in three dimensions on the host: axis, section, recesses, track and furniture; needs no scene folder.

The wall is given by its distance from the axis over station and angle. The angle is measured from the left towards the
crown, so that 0 is the left wall, π/2 the crown, and 3π/2 the floor, which is part of the section.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

SPACING = (0.18, 0.2)  # of the points of the triangulated wall, along and around, m; as the scene's meshes have them
_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
N_BRICK = 13


@dataclasses.dataclass(frozen=True)
class ShellLining:
    """Things of one variant of the lining."""

    # Recesses: station and angle of the middle, length along and width around the wall, depth (m, rad), `(p, 5)`.
    # Niches are recesses.
    pocket: np.ndarray
    brick: np.ndarray  # furniture, see `make_bricks`, `(k, 13)`
    seam: float = 1.5 * np.pi  # angle at which the wall is cut open to be unrolled, rad; no recess lies there
    radius: np.ndarray | None = None  # section of this variant, m, `(n, m)`; `None` where it is the shell's


@dataclasses.dataclass(frozen=True)
class Shell:
    """A bore in three dimensions, in the tunnel frame."""

    station: np.ndarray  # uniform stations from 0, m, `(n,)`; those of the plan, or others
    position: np.ndarray  # axis through the middle of the section, m, `(n, 3)`
    tangent: np.ndarray  # unit vectors of growing station, with the grade, `(n, 3)`
    angle: np.ndarray  # directions around the axis, uniform and growing over one turn less a step, rad, `(m,)`
    radius: np.ndarray  # distance of the smooth wall from the axis, m, `(n, m)`
    section: np.ndarray  # mean section, by which the wall is unrolled, m, `(m,)`
    track: np.ndarray  # rails, sleepers and slab of every variant, see `make_bricks`, `(t, 13)`
    linings: dict[str, ShellLining]  # variant name to what it adds
    spacing: tuple[float, float] = SPACING  # distance of the points of the triangulated wall, along and around, m
    window: tuple[float, float] = (0.0, np.inf)  # first and last station of the stretch that was cut out, m

    @property
    def left(self) -> np.ndarray:
        """Unit vectors to the left, level, `(n, 3)`."""
        level = np.hypot(self.tangent[:, 0], self.tangent[:, 1])
        return np.stack([-self.tangent[:, 1] / level, self.tangent[:, 0] / level, np.zeros(len(level))], axis=-1)

    @property
    def up(self) -> np.ndarray:
        """Unit vectors across the axis towards the crown, `(n, 3)`."""
        return np.cross(self.tangent, self.left)

    def cut(self, start: float, end: float) -> Shell:
        """Return the stretch between two stations of this stretch, m. Its arrays stay whole, so that no point moves."""
        first, last = self.window
        return dataclasses.replace(self, window=(first + start, min(first + end, last)))


def make_bricks(
    centre: Float[np.ndarray, "k 3"],
    heading: Float[np.ndarray, " k"],
    half: Float[np.ndarray, "k 3"],
    taper: Float[np.ndarray, " k"] | float = 0.0,
) -> Float[np.ndarray, "k 13"]:
    """Return level boxes as rows: centre (3), half edges along, left and up as vectors (9), taper (1).

    Args:
        centre: Middles, m.
        heading: Heading of the long edge in the tunnel frame, rad.
        half: Halves of the edges: along the heading, to the left, upwards, m.
        taper: Fraction by which the length is less at the top than in the middle, and more at the foot; 0 for a box.
    """
    cos, sin, zero = np.cos(heading), np.sin(heading), np.zeros(len(centre))
    along, left = np.stack([cos, sin, zero], axis=-1), np.stack([-sin, cos, zero], axis=-1)
    up = np.broadcast_to([0.0, 0.0, 1.0], along.shape)
    edges = [edge * size[:, None] for edge, size in zip((along, left, up), np.transpose(half), strict=True)]
    return np.column_stack([centre, *edges, np.broadcast_to(taper, len(centre))])


def brick_corners(brick: Float[np.ndarray, "k 13"]) -> Float[np.ndarray, "k 8 3"]:
    """Return the corners of bricks, m; bit 2 of a corner's number is along, bit 1 left, bit 0 up."""
    half, taper = brick[:, 3:12].reshape(-1, 3, 3), brick[:, 12]
    fraction = np.repeat(_CORNERS[None], len(brick), axis=0)
    fraction[..., 0] *= 1.0 - taper[:, None] * fraction[..., 2]
    return brick[:, None, :3] + np.einsum("kci,kij->kcj", fraction, half)
