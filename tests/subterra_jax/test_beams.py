"""Beam patterns: counts, unit vectors and fields of view."""

import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax import lidar
from subterra_jax.lidar3d import beams


@pytest.mark.parametrize(
    ("pattern", "count"),
    [(beams.planar(16), 16), (beams.spinning(np.linspace(-0.3, 0.3, 16), 1800), 28_800), (beams.rosette(), 24_000)],
)
def test_beams_are_unit_vectors_and_as_many_as_the_sensor_has(pattern, count):
    assert pattern.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(pattern, axis=1), 1.0, atol=1e-6)


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
