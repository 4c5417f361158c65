"""The true bore: everything that is drawn once and then surveyed."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from scene.survey.alignment import Alignment, Elements, draw_grade, draw_railway, draw_s_bend, lay_out, metro_elements
from scene.survey.config import TruthName
from scene.survey.furniture import Furniture, draw_furniture
from scene.survey.mesh import Mesh, join_meshes, nail_mesh, surface_mesh, track_mesh
from scene.survey.section import Section, Shape, Trend, arch, circle, d_shape, draw_field, ellipse, horseshoe

_IRREGULAR_SIGMA = 0.13  # m, standard deviation of the walls
_CROSSFALL = 0.02  # of the irregular bore's floor


@dataclass(frozen=True)
class Bore:
    """Centreline, section and furniture of one bore, and the name of its class of section."""

    section_type: str
    alignment: Alignment
    section: Section
    furniture: Furniture

    def mesh(self) -> Mesh:
        """Return every surface that a ray can meet."""
        parts = (self.alignment, self.section, self.furniture)
        mesh = join_meshes([surface_mesh(*parts), track_mesh(*parts), nail_mesh(*parts)])
        # To the micrometre, so that the last bits of a matrix product do not decide about the bytes of a survey.
        return replace(mesh, vertices=np.round(mesh.vertices, 6))


def _wider_middle(length: float) -> Trend:
    """1 m wider over the middle third, with ramps of an eighth of the length, at most 8 m."""
    ramp, third = min(8.0, length / 8.0), length / 3.0
    return Trend((third - 0.5 * ramp, third + 0.5 * ramp, 2 * third - 0.5 * ramp, 2 * third + 0.5 * ramp), (0, 1, 1, 0))


def _flared_end(length: float) -> Trend:
    """Return a portal 3 m wider at the last mouth, opening with the square of the distance over 6 m."""
    share = np.linspace(0.0, 1.0, 7)
    return Trend(tuple(length - 6.0 + 6.0 * share), tuple(3.0 * share**2))


@dataclass(frozen=True)
class _Class:
    section_type: str
    shape: Callable[[], Shape] = d_shape
    elements: Callable[[np.random.Generator, float], Elements] = draw_railway
    widening: Callable[[float], Trend] = lambda length: Trend()
    rough: bool = False


_CLASSES: dict[TruthName, _Class] = {
    "paper": _Class("D"),
    "metro": _Class("D", elements=metro_elements),
    "ellipse": _Class("ellipse", ellipse),
    "widening": _Class("D, widening", widening=_wider_middle),
    "horseshoe": _Class("horseshoe", horseshoe),
    "s-bend": _Class("D", elements=draw_s_bend),
    "grade": _Class("D", elements=draw_grade),
    "irregular": _Class("irregular", arch, widening=_flared_end, rough=True),
    "circle": _Class("circle", circle),
}


def _draw_section(rng: np.random.Generator, kind: _Class, length: float, correlation: float) -> Section:
    """Draws width and height (1 σ of 5 cm over 8 to 15 m) and roughness (1 cm over 1 to 2 m, or irregular)."""
    return Section(
        kind.shape(),
        width_field=draw_field(rng, 0.05, rng.uniform(8.0, 15.0)),
        height_field=draw_field(rng, 0.05, rng.uniform(8.0, 15.0)),
        roughness=draw_field(
            rng,
            _IRREGULAR_SIGMA if kind.rough else 0.01,
            correlation if kind.rough else rng.uniform(1.0, 2.0),
            dims=2,
            terms=256,
        ),
        widening=kind.widening(length),
        crossfall=_CROSSFALL if kind.rough else 0.0,
    )


def draw_bore(
    seed: np.random.SeedSequence, length: float, truth: TruthName = "paper", correlation: float = 2.0
) -> Bore:
    """Draws a bore of a length between the mouths, m, and a class.

    `correlation` is the length in which the walls of `irregular` decorrelate, m; the others do not use it.
    """
    first, second, third = (np.random.default_rng(s) for s in seed.spawn(3))
    kind = _CLASSES[truth]
    return Bore(
        kind.section_type,
        lay_out(first, length, kind.elements(first, length)),
        _draw_section(second, kind, length, correlation),
        draw_furniture(third, length, rings=not kind.rough),
    )
