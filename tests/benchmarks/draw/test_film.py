"""A film shows the episode that was driven, from its start to its end, and its end is said."""

import io

import numpy as np
import pytest
from PIL import Image

from benchmarks.draw import film


@pytest.fixture(scope="module")
def episode():
    return film.drive_whole(film.FilmConfig(task="Subterra/TraverseShort-v1", agent="dead-reckoning"))[1:]


def test_a_film_has_as_many_pictures_as_asked_and_they_move(episode):
    params, drawn = episode
    picture = Image.open(io.BytesIO(film.film(params, drawn, "a film", 3)))
    assert picture.n_frames == 3
    shown = []
    for k in range(3):
        picture.seek(k)
        shown.append(np.asarray(picture.convert("RGB"), float))
    assert min(np.abs(shown[0] - shown[1]).mean(), np.abs(shown[1] - shown[2]).mean()) > 0.5


def test_beams_end_at_the_walls_that_are_drawn(episode):
    """The tips, turned into the tunnel's direction, lie on a segment of the walls within the noise of a range."""
    params, drawn = episode
    row = len(drawn) // 2
    heading = float(drawn.heading[row])
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    near = (ends := film.tips(drawn, row))[np.linalg.norm(ends, axis=1) < 8.0]
    tips = near @ turn.T + drawn.trace.state.position[row]
    assert len(tips) > 4
    start, end = film.wall_segments(params.tunnel).transpose(1, 0, 2)
    along = end - start
    length = np.maximum(np.sum(along**2, axis=1), 1e-12)
    share = np.clip(np.einsum("psj,sj->ps", tips[:, None] - start, along) / length, 0.0, 1.0)
    gap = np.linalg.norm(tips[:, None] - start - share[..., None] * along, axis=-1).min(axis=1)
    assert gap.max() < 0.15
