"""Rough walls as triangles: every cell lists what goes through it, and rolled and wide beams meet what is there."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax import lidar, lidar3d
from subterra_jax.host.errors import TunnelError
from subterra_jax.host.unrolled import delaunay
from subterra_jax.lidar3d import beams, cells, relief, rolled, surface
from subterra_jax.lidar3d.relief import ARRAYS, Relief
from subterra_jax.lidar3d.space import Space
from subterra_jax.lidar3d.surface import split_boxes
from subterra_jax.procedural import open_world
from tests.recorded import check
from tests.subterra_jax import surfaces

TABLE = Path(__file__).with_name("values.csv")


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
    fraction = np.random.default_rng(0).dirichlet(np.ones(3), len(corner))
    points = np.einsum("tk,tki->ti", fraction, corner)
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
    monkeypatch.setattr(cells, "MOST_VERTICES", 800)
    assert len(cells.sort_triangles(axis, tube, 4.0).low) == 8  # halved once
    monkeypatch.setattr(cells, "MOST_VERTICES", 60)
    with pytest.raises(TunnelError, match="too fine for the LiDAR: 8192 triangles over 16 m"):
        cells.sort_triangles(axis, tube, 4.0)
    with pytest.raises(ValueError, match="no triangle lies along the axis"):
        Relief.from_triangles(axis, surface.Triangles(*surfaces.box((500.0, 0.0, 0.0), (1.0, 1.0, 1.0))))


def test_what_cannot_be_stacked_is_refused():
    one = Relief.from_plan(upright())
    with pytest.raises(ValueError, match="at least one relief"):
        relief.stack_reliefs([])
    with pytest.raises(ValueError, match="relief 0 is a stack of 2"):
        relief.stack_reliefs([relief.stack_reliefs([one, one])])
    assert relief.stack_reliefs([one]) is one


def upright():
    """A bend with a grade, a pocket and furniture, of which no shell is known."""
    station = np.linspace(0.0, 12.0, 13)
    line = 40.0 * np.stack([np.sin(station / 40.0), 1.0 - np.cos(station / 40.0)], axis=-1)
    plan = st.tunnel.from_centreline(line, 2.5, pockets=[[6.0, 1, 0.4, 0.3]], elevation=0.04 * station)
    across = np.array([[4.0, -1.0, 5.0, -1.2]])
    return dataclasses.replace(plan, linings={"built": dataclasses.replace(plan.lining("pockets"), furniture=across)})


BORES = {
    "furnished": lambda: (st.load_tunnel("metro").slice(100.0, 9.0), "furnished"),
    "rough": lambda: (open_world.plan("open:rock:test-unseen:49", variants=("built",), length=7.0), "built"),
    "even": lambda: (open_world.plan("open:cast:train:73", variants=("smooth",), length=5.0), "smooth"),
    "upright": lambda: (upright(), "built"),
}


def told(space):
    """Contents of a tunnel's space, its words taken apart."""
    one, (frame, link, cell, entry, vertex) = space.relief, (np.asarray(getattr(space.relief, n)) for n in ARRAYS[:-1])
    code, half = np.sort(entry.view(np.uint32)).astype(int), np.ascontiguousarray(cell).view(np.uint16).reshape(-1, 4)
    return {
        "numbers": [np.asarray(one.length), np.asarray(one.first_block), np.asarray(one.n_blocks)],
        "frame": np.split(frame, [3, 12, 20, 21, 22, 23, 24, 25], axis=1),
        **{"link": link, "cell": half, "entry": np.stack([code >> 20, code >> 10 & 1023, code & 1023], axis=-1)},
        **{"vertex": np.hstack([vertex >> 10, vertex & 1023]), "ground": np.asarray(space.ground)},
        "box": np.asarray(one.box).reshape(-1, 4),
    }


def test_a_surface_goes_to_the_device_as_it_did():
    spaces = {name: Space.from_plan(*make()) for name, make in BORES.items()}
    for name, space in (spaces | {"stack": Space.join(list(spaces.values()))}).items():
        check(TABLE, f"space {name}", told(space))
    assert Space.join([spaces["upright"], None]) is None


def as_set(faces: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(sorted(face)) for face in faces.tolist()}


@pytest.mark.parametrize("name", ["open:cast:train:73", "open:masonry:train:60", "open:rock:test-unseen:49"])
@pytest.mark.parametrize("window", [None, (9.3, 17.0)])
def test_every_triangle_is_delaunays_and_looks_inwards(name, window, monkeypatch):
    shell = open_world.plan(name, variants=("built",), length=30.0).shell
    found = []

    def searched(grid, girth, length, real=rolled._faces):
        faces, (u, s, *_) = real(grid, girth, length), grid
        found.append((faces, delaunay(u, s, girth), u, s, girth))
        return faces

    monkeypatch.setattr(rolled, "_faces", searched)
    rolled.raise_shell(shell if window is None else shell.cut(*window), "built")
    ((faces, expected, u, s, girth),) = found
    assert len(faces) == len(expected) > 3000
    assert as_set(faces) == as_set(expected)
    across, along = ((values[faces] - values[faces[:, :1]])[:, 1:] for values in (u, s))
    across = (across + girth / 2) % girth - girth / 2
    assert (across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0] > 0.0).all()


def test_a_wall_without_recess_or_corner_is_a_plain_grid_open_at_both_ends():
    _, wall, *_ = rolled.raise_parts(st.load_tunnel("metro").shell.cut(100.0, 160.0), "smooth")
    edges = np.sort(wall.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = np.unique(edges, axis=0, return_counts=True)[1]
    assert count.max() == 2
    assert len(wall.faces) == 2 * len(wall.vertices) - (count == 1).sum()  # Euler's formula for a tube


def test_beams_up_and_down_meet_crown_and_floor_of_a_tunnel_of_a_stack() -> None:
    plans = [st.load_tunnel(f"open:val:{i}").slice(20.0, 30.0) for i in range(2)]
    plans = [dataclasses.replace(plan, elevation=0.0 * plan.elevation) for plan in plans]
    relief = lidar3d.stack_reliefs([lidar3d.Relief.from_plan(plan) for plan in plans])
    poses = reference.random_poses(plans[1], 64, np.random.default_rng(9))
    place = np.column_stack([poses.position, np.full(64, 0.7)]).astype(np.float32)
    beam = jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    one = lambda k, place, station: surfaces.ranges(relief.pick(k), place, beam, station)  # noqa: E731
    ranges = jax.jit(jax.vmap(one))(np.ones(64, int), place, poses.station)
    np.testing.assert_allclose(ranges, np.tile([5.3, 0.7], (64, 1)), atol=1e-4)


def test_a_packaged_tunnel_is_raised_along_its_grade_and_a_lidar_above_the_crown_is_refused() -> None:
    plan = dataclasses.replace(st.load_tunnel().slice(100.0, 40.0), shell=None)
    relief = lidar3d.Relief.from_plan(plan)
    assert sum(leaf.nbytes for leaf in jax.tree.leaves(relief)) < 2e6
    mid = len(plan.station) // 2
    place = jnp.asarray([*plan.centre[mid], plan.elevation[mid] + 1.0], jnp.float32)
    down = surfaces.ranges(relief, place, jnp.array([[0.0, 0.0, -1.0]]), jnp.float32(plan.station[mid]))
    np.testing.assert_allclose(down, [1.0], atol=1e-3)
    with pytest.raises(st.SubterraError, match=r"below the assumed crown at 6 m, is at 6.5 m"):
        lidar3d.Relief.from_plan(dataclasses.replace(plan, lidar_height=6.5))


def test_the_level_ring_is_the_one_above_the_middle_and_a_scan_of_one_row_is_level_as_a_whole():
    image, row = np.arange(256), np.arange(24)
    assert beams.level_ring(image, (4, 64)).tolist() == list(range(128, 192, 4))
    assert beams.level_row(image, (4, 64)).tolist() == list(range(128, 192))
    assert beams.level_ring(image[:128], (2, 64)).tolist() == list(range(64, 128, 4))
    np.testing.assert_array_equal(beams.level_ring(row, (1, 24)), row)
    assert [beams.n_level(shape) for shape in ((4, 64), (2, 64), (1, 24))] == [16, 16, 24]


def test_the_planar_pattern_is_that_of_the_planar_lidar():
    level = np.asarray(lidar.beam_directions(jnp.float32(0.0), 16))
    np.testing.assert_allclose(beams.planar(16), np.column_stack([level, np.zeros(16)]), atol=1e-6)


def test_a_rosette_stays_in_its_field_of_view_and_does_not_repeat():
    first, second = beams.rosette(), beams.rosette(start=0.1)
    azimuth, elevation = np.arctan2(first[:, 1], first[:, 0]), np.arcsin(first[:, 2])
    assert np.abs(azimuth).max() == pytest.approx(np.deg2rad(35.2), rel=0.01)
    assert np.abs(elevation).max() == pytest.approx(np.deg2rad(38.6), rel=0.01)
    assert np.abs(first - second).max() > 0.1


@pytest.mark.parametrize("make", [lambda: beams.planar(0), lambda: beams.spinning(np.array([1.6]), 4)])
def test_an_impossible_pattern_is_refused(make):
    with pytest.raises(ValueError, match="must"):
        make()
