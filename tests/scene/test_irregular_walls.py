"""Walls as irregular as a mine's, followed between profiles at least as well as by straight lines."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter

from scene.bore import Bore
from tests.scene.fits import rebuilt

LENGTH, SPACING, STEP, COLUMNS = 30.0, 1.0, 0.1, 180
SD = 0.13
LINE = (np.full(3, 50.0), np.array([50.0 + LENGTH, 50.0, 50.0]))
BEFORE = 5.0  # m of relief before the first station, so that nothing depends on an edge


@dataclass(frozen=True)
class Irregular:
    """A bore with a flat bed that falls across, rails on it, and walls that wander."""

    relief: np.ndarray

    @classmethod
    def drawn(cls, correlation: float, seed: int) -> "Irregular":
        rows = int((LENGTH + 2 * BEFORE) / STEP) + 1
        noise = np.random.default_rng(seed).standard_normal((rows, COLUMNS))
        around = min(correlation, 1.0) / (2 * np.pi * 2.9 / COLUMNS) / 2
        relief = gaussian_filter(noise, (correlation / STEP / 2, around), mode=("nearest", "wrap"))
        return cls(relief / relief.std() * SD)

    def radius(self, station: float, angle: np.ndarray) -> np.ndarray:
        """Of the wall about the middle, m."""
        row = self.relief[round((station + BEFORE) / STEP)]
        at = (angle + np.pi) / (2 * np.pi) * COLUMNS
        smooth = np.minimum(2.5 / np.maximum(np.abs(np.cos(angle)), 1e-6), 2.5 + 0.3 * np.maximum(np.sin(angle), 0))
        return smooth + np.interp(at % COLUMNS, np.arange(COLUMNS + 1), np.append(row, row[0]))

    def profile(self, station: float, count: int, rng: np.random.Generator) -> np.ndarray:
        """Wall, bed and rails at one station, m."""
        angle = rng.uniform(-np.pi, np.pi, count)
        radius = self.radius(station, angle)
        y, z = radius * np.cos(angle), radius * np.sin(angle)
        low = z < -2.4 + 0.03 * y
        shrink = np.where(low, (-2.4) / np.minimum(z - 0.03 * y, -1e-6), 1.0)
        rails = np.stack([rng.choice([-0.75, 0.75], 90) + rng.uniform(-0.035, 0.035, 90), rng.uniform(-2.3, -2.15, 90)])
        across, up = np.concatenate([[y * shrink, z * shrink], rails], axis=1)
        points = np.stack([np.full(len(across), station), across, up], axis=1)
        return points + rng.normal(0, 0.004, points.shape)


def missed(bore: Bore, origin: np.ndarray, held: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """Radial distance of held-out wall points from the bore, m."""
    station, lateral, upward = bore.axis.local(held[wall] + 50.0 - origin)
    turn = bore.angle[1] - bore.angle[0]
    angle = np.concatenate([[bore.angle[0] - turn], bore.angle, [bore.angle[-1] + turn]])
    radius = np.concatenate([bore.radius[:, -1:], bore.radius, bore.radius[:, :1]], axis=1)
    at = RegularGridInterpolator((bore.station, angle), radius, bounds_error=False, fill_value=None)
    return np.abs(at(np.stack([station, np.arctan2(upward, lateral)], axis=1)) - np.hypot(lateral, upward))


def linear(tunnel: Irregular, profiles: np.ndarray, held: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """The same for straight lines between the exact neighbouring profiles, m."""
    station, angle = held[wall][:, 0], np.arctan2(held[wall][:, 2], held[wall][:, 1])
    low = np.clip(np.searchsorted(profiles, station) - 1, 0, len(profiles) - 2)
    near, far = (
        np.array([tunnel.radius(profiles[k + ahead], np.array([a]))[0] for k, a in zip(low, angle, strict=True)])
        for ahead in (0, 1)
    )
    share = (station - profiles[low]) / SPACING
    return np.abs((1 - share) * near + share * far - np.hypot(held[wall][:, 1], held[wall][:, 2]))


@pytest.mark.parametrize(
    ("correlation", "mean", "within"),
    [(1.0, 0.042, 0.94), (2.0, 0.012, 0.99), (4.0, 0.008, 0.99)],
)
def test_profiles_a_metre_apart_give_the_wall_between_them(correlation, mean, within):
    tunnel, rng = Irregular.drawn(correlation, seed=4), np.random.default_rng(8)
    profiles = np.arange(0.3, LENGTH, SPACING)
    cloud = np.concatenate([tunnel.profile(station, 2500, rng) for station in profiles])
    held = np.concatenate([tunnel.profile(station, 250, rng) for station in profiles[1:-2] + SPACING / 2])
    angle = np.arctan2(held[:, 2], held[:, 1])
    wall = (held[:, 2] > -1.9) & (np.abs(np.hypot(held[:, 1], held[:, 2]) - 2.6) < 0.9) & np.isfinite(angle)
    bore, thinned = rebuilt(cloud + 50.0)
    error, peer = missed(bore, thinned.origin, held, wall), linear(tunnel, profiles, held, wall)
    assert error.mean() < mean
    assert (error < 0.10).mean() > within
    assert error.mean() < peer.mean() + 0.004  # the noise of the points, which the peer's profiles do not have


def test_a_person_between_two_profiles_is_no_wall():
    tunnel, rng = Irregular.drawn(4.0, seed=1), np.random.default_rng(2)
    profiles = np.arange(0.3, LENGTH, SPACING)
    cloud = np.concatenate([tunnel.profile(station, 2500, rng) for station in profiles])
    person = np.array([15.3, 1.6, -1.2]) + rng.normal(0, [0.02, 0.12, 0.4], (500, 3))
    alone, _ = rebuilt(cloud + 50.0, LINE)
    beside, _ = rebuilt(np.concatenate([cloud, person]) + 50.0, LINE)
    assert np.abs(alone.width - beside.width).max() < 0.06
