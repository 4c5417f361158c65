"""Cells list every triangle that comes near them."""

import numpy as np
import pytest

from subterra_jax.host.errors import TunnelError
from subterra_jax.lidar3d import cells, relief, surface
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.lidar3d.surface import split_boxes
from tests.subterra_jax import surfaces


@pytest.fixture(scope="module")
def sorted_bend():
    axis = surfaces.axis_of(30.0, 1 / 60.0)
    vertices, faces = surfaces.tube(axis, 2.0, 24, 31)
    return cells.sort_triangles(surface.Axis(**axis), surface.Triangles(vertices, faces), 8.0), vertices[faces]


def listed_corners(found: cells.Cells, block: int, cell: int) -> np.ndarray:
    """Corners of a cell's triangles in the block's frame, m."""
    word = found.cell.astype(np.int64) & 0xFFFFFFFF
    code = found.entry[word[cell, 0] : word[cell, 0] + (word[cell, 1] >> 16)].astype(np.int64) & 0xFFFFFFFF
    first = found.first_vertex[block] + (code >> 20)
    point = found.vertex[np.stack([first, first + ((code >> 10) & 1023), first + (code & 1023)], axis=-1)]
    x = ((point[..., 0] & 1023) << 10 | (point[..., 1] & 1023)) - (1 << 19)
    return np.concatenate([x[..., None] * found.unit[0], (point >> 10) * found.unit[1]], axis=-1)


def test_every_point_of_every_triangle_lies_in_a_cell_that_lists_a_triangle_through_it(sorted_bend):
    found, corner = sorted_bend
    share = np.random.default_rng(0).dirichlet(np.ones(3), len(corner))
    points = np.einsum("tk,tki->ti", share, corner)
    seen, blocks = np.zeros(len(points), bool), found.blocks
    n_x = len(found.cell) // (len(found.low) * cells.N_WEDGES)
    for k, (centre, turn) in enumerate(zip(blocks.centre, blocks.turn, strict=True)):
        local = (points - centre) @ turn.T
        inside = (local @ blocks.front[k, :3] <= blocks.front[k, 3]) & (local @ blocks.back[k, :3] >= blocks.back[k, 3])
        x = np.clip((local[:, 0] - found.low[k]) / found.pitch, 0, n_x - 1).astype(int)
        wedge = cells.wedge_place(local[:, 1], local[:, 2]).astype(int)
        for p in np.flatnonzero(inside):
            cell = (k * n_x + x[p]) * cells.N_WEDGES + wedge[p]
            rows = listed_corners(found, k, cell)
            normal = np.cross(rows[:, 1] - rows[:, 0], rows[:, 2] - rows[:, 0])
            gap = np.einsum("ij,ij->i", local[p] - rows[:, 0], normal) / np.linalg.norm(normal, axis=1)
            assert np.abs(gap).min() < 2e-5
            edges = cells.wedge_edge(np.array([wedge[p]])) + cells.wedge_edge(np.array([wedge[p] + 1]))
            assert local[p, 1:] @ edges[0] >= (found.cell[cell, 1] & 0xFFFF) * cells.NEAR_UNIT
            seen[p] = True
    assert seen.all()


def test_boxes_are_told_from_other_triangles():
    box = surface.Triangles(surface.BOX_CORNERS * [0.2, 0.3, 0.4] + [1.0, 2.0, 3.0], surface.BOX_FACES)
    leaning = surface.Triangles(box.vertices + 0.5 * box.vertices[:, [1, 2, 0]], surface.BOX_FACES)
    tube = surface.Triangles(*surfaces.tube(surfaces.axis_of(10.0), 2.0, 8, 5))
    bent = surface.Triangles(box.vertices + 0.01 * (np.arange(8) == 3)[:, None], surface.BOX_FACES)
    rest, boxes = split_boxes(surface.join_surfaces([tube, box, leaning, bent, tube]))
    assert len(rest.faces) == 2 * len(tube.faces) + 12
    np.testing.assert_allclose(boxes.centre, [[1.0, 2.0, 3.0], [2.0, 3.5, 3.5]])
    np.testing.assert_allclose(np.sort(np.abs(boxes.half[0]).max(axis=0)), [0.2, 0.3, 0.4])
    np.testing.assert_allclose(boxes.corners()[1], leaning.vertices)


def test_a_surface_too_fine_for_the_integers_gets_shorter_blocks_or_is_refused(monkeypatch):
    axis = surface.Axis(**surfaces.axis_of(16.0))
    tube = surface.Triangles(*surfaces.tube(surfaces.axis_of(16.0), 2.0, 64, 65))
    monkeypatch.setattr(cells, "MOST_VERTICES", 600)
    assert len(cells.sort_triangles(axis, tube, 4.0).low) > 4
    monkeypatch.setattr(cells, "MOST_VERTICES", 60)
    with pytest.raises(TunnelError, match="too fine for the LiDAR: 8192 triangles over 16 m"):
        cells.sort_triangles(axis, tube, 4.0)


def test_what_cannot_be_stacked_is_refused():
    axis, tube = (
        surface.Axis(**surfaces.axis_of(8.0)),
        surface.Triangles(*surfaces.tube(surfaces.axis_of(8.0), 2.0, 8, 9)),
    )
    one = Relief.from_triangles(axis, tube)
    with pytest.raises(ValueError, match="at least one relief"):
        relief.stack_reliefs([])
    with pytest.raises(ValueError, match="relief 0 is a stack of 2"):
        relief.stack_reliefs([relief.stack_reliefs([one, one])])
    assert relief.stack_reliefs([one]) is one


def test_a_surface_away_from_the_axis_is_refused():
    axis = surfaces.axis_of(30.0)
    far = surfaces.box((500.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="no triangle lies along the axis"):
        Relief.from_triangles(surface.Axis(**axis), surface.Triangles(*far))
