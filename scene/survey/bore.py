"""The true bore: everything that is drawn once and then surveyed."""

from dataclasses import dataclass, replace

import numpy as np

from scene.survey.alignment import Alignment, draw_alignment
from scene.survey.furniture import Furniture, draw_furniture
from scene.survey.mesh import Mesh, join
from scene.survey.section import Section, draw_section
from scene.survey.solids import nail_mesh, track_mesh
from scene.survey.surface import surface_mesh


@dataclass(frozen=True)
class Bore:
    """Centreline, section and furniture of one bore."""

    alignment: Alignment
    section: Section
    furniture: Furniture

    def mesh(self) -> Mesh:
        """Every surface that a ray can meet."""
        shape = (self.alignment, self.section, self.furniture)
        mesh = join([surface_mesh(*shape), track_mesh(*shape), nail_mesh(*shape)])
        # To the micrometre, so that the last bits of a matrix product do not decide about the bytes of a survey.
        return replace(mesh, vertices=np.round(mesh.vertices, 6))


def draw_bore(seed: np.random.SeedSequence, length: float) -> Bore:
    """Draw a bore of `length` m."""
    first, second, third = (np.random.default_rng(s) for s in seed.spawn(3))
    return Bore(draw_alignment(first, length), draw_section(second), draw_furniture(third, length))
