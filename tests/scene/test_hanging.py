"""Pipes, trays and ducts under a ceiling are things in the bore; walls, corners and platforms are not."""

import numpy as np
import pytest

from scene.cleaning.tube import bridge_hanging

ANGLE = -np.pi + 2 * np.pi * (np.arange(120) + 0.5) / 120


def box(left: float, right: float, up: float, down: float) -> np.ndarray:
    """Distances to the sides of a box about the axis, m."""
    cos, sin = np.cos(ANGLE), np.sin(ANGLE)
    across = np.where(cos > 0, left, right) / np.abs(cos)
    return np.minimum(across, np.where(sin > 0, up, down) / np.abs(sin))


def round_thing(left: float, above: float, radius: float) -> np.ndarray:
    """Distances to a pipe, m; infinite beside it."""
    along = left * np.cos(ANGLE) + above * np.sin(ANGLE)
    inside = radius**2 - (left**2 + above**2 - along**2)
    return np.where((inside > 0) & (along > 0), along - np.sqrt(np.maximum(inside, 0.0)), np.inf)


CORRIDOR = box(2.55, 2.55, 2.2, 2.2)
ARCH = np.minimum(np.where(np.sin(ANGLE) > 0, 2.75, np.inf), box(2.75, 2.75, 9.0, 2.75))
HANGS = {
    "pipe": (CORRIDOR, round_thing(-1.1, 1.55, 0.16)),
    "two pipes": (CORRIDOR, np.minimum(round_thing(-1.1, 1.55, 0.16), round_thing(0.6, 1.55, 0.16))),
    "duct": (ARCH, round_thing(0.0, 2.0, 0.4)),
}


@pytest.mark.parametrize("name", HANGS)
def test_the_ceiling_goes_on_behind_what_hangs_under_it(name):
    bare, thing = HANGS[name]
    seen = np.minimum(bare, thing)
    assert (bare - seen).max() > 0.4
    bridged = bridge_hanging(np.stack([bare, seen]), ANGLE)
    np.testing.assert_array_equal(bridged[0], bare)
    np.testing.assert_allclose(bridged[1], bare, atol=0.12)  # the line cuts a round crown's arc off


STAYS = {
    "corridor": CORRIDOR,
    "arch": ARCH,
    "a hall of 16 m": box(8.0, 8.0, 3.0, 1.5),
    "a haunch in the corner": np.minimum(CORRIDOR, 2.6 / np.abs(np.cos(ANGLE - np.pi / 4)).clip(0.3)),
    "a platform": np.minimum(CORRIDOR, np.where((ANGLE > -1.2) & (ANGLE < 0), 1.2 / np.abs(np.sin(ANGLE)), np.inf)),
    "something on the floor": np.minimum(CORRIDOR, np.where(np.abs(ANGLE + np.pi / 2) < 0.3, 1.2, np.inf)),
    "a crown that comes down": box(2.55, 2.55, 2.2, 2.2) - 0.3 * np.exp(-((ANGLE - np.pi / 2) ** 2) / 0.1),
}


@pytest.mark.parametrize("name", STAYS)
def test_walls_corners_and_what_stands_on_the_floor_stay(name):
    np.testing.assert_array_equal(bridge_hanging(STAYS[name][None], ANGLE)[0], STAYS[name])
