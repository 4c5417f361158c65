"""The wall rolled out flat: the triangles that are known without a search are those that a search finds."""

import numpy as np
import pytest

from subterra_jax.lidar3d import rolled
from subterra_jax.procedural import open_world


def as_set(faces: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(sorted(face)) for face in faces.tolist()}


@pytest.mark.parametrize("name", ["open:cast:train:73", "open:masonry:train:60", "open:rock:test-unseen:49"])
@pytest.mark.parametrize("window", [None, (9.3, 17.0)])
def test_every_triangle_is_delaunays_and_looks_inwards(name, window, monkeypatch):
    shell = open_world.plan(name, variants=("built",), length=30.0).shell
    found = []

    def searched(u, s, node, shape, girth, length, real=rolled._faces):
        faces = real(u, s, node, shape, girth, length)
        found.append((faces, rolled._delaunay(u, s, girth), u, s, girth))
        return faces

    monkeypatch.setattr(rolled, "_faces", searched)
    rolled.raise_shell(shell if window is None else shell.cut(*window), "built")
    ((faces, expected, u, s, girth),) = found
    assert len(faces) == len(expected) > 3000
    assert as_set(faces) == as_set(expected)
    across, along = ((values[faces] - values[faces[:, :1]])[:, 1:] for values in (u, s))
    across = (across + girth / 2) % girth - girth / 2
    assert (across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0] > 0.0).all()
