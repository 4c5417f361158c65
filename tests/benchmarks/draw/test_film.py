"""A film shows the episode that was driven, from its start to its end; a camera stands anywhere in a scene."""

import io

import numpy as np
import pytest
from PIL import Image

from benchmarks.draw import film
from benchmarks.draw.scene import Pose


@pytest.fixture(scope="module")
def episode():
    return film.drive_episode(film.FilmConfig(task="Subterra/TraverseShort-v1", agent="dead-reckoning"))


def test_a_film_has_as_many_pictures_as_asked_and_they_move(episode):
    picture = Image.open(io.BytesIO(film.film(*episode[:2], "a title", 3)))
    assert picture.n_frames == 3
    shown = []
    for k in range(3):
        picture.seek(k)
        shown.append(np.asarray(picture.convert("RGB"), float))
    assert min(np.abs(shown[0] - shown[1]).mean(), np.abs(shown[1] - shown[2]).mean()) > 0.5


def test_a_robot_by_physics_is_seen_from_behind_above_the_plan(episode):
    plain, seen = (
        Image.open(io.BytesIO(film.film(*episode[:2], "a title", 2, view)))
        for view in (None, lambda row: np.full((340, 760, 3), (255, 0, 0), np.uint8))
    )
    assert seen.size[1] > plain.size[1]
    assert np.asarray(seen.convert("RGB"), int)[200, 400] @ [1, -1, -1] > 200


def test_beams_end_at_the_walls_that_are_drawn(episode):
    """The returns, turned into the tunnel's direction, lie on the walls within the noise of a range."""
    drawn, *_ = episode
    row = len(drawn) // 2
    cos, sin = np.cos(drawn.heading[row]), np.sin(drawn.heading[row])
    hits = drawn.hits[row, :, :2]
    ends = hits[np.linalg.norm(hits, axis=1) < 8.0] @ np.array([[cos, sin], [-sin, cos]]) + drawn.truth[row, :2]
    assert len(ends) > 4
    lines = film.wall_lines(drawn)
    start, end = (np.concatenate([line[part] for line in lines]) for part in (slice(None, -1), slice(1, None)))
    along = end - start
    fraction = np.einsum("psj,sj->ps", ends[:, None] - start, along) / np.maximum(np.sum(along**2, axis=1), 1e-12)
    gap = np.linalg.norm(ends[:, None] - start - np.clip(fraction, 0.0, 1.0)[..., None] * along, axis=-1).min(axis=1)
    assert gap.max() < 0.25


def test_the_axes_of_a_camera_are_right_up_and_ahead():
    pose = Pose(np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0]), np.pi / 2, 120, 90)
    np.testing.assert_allclose(pose.axes, [[0, -1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)
