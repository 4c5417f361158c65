"""The floor is the floor, whatever stands on it, hides it, or lies along its walls."""

import numpy as np
import pytest

from scene.bore import Bore
from scene.fitting import floor
from scene.fitting.section import fit_sections
from tests.scene import railway
from tests.scene.fits import fitted, keep, straight, thin
from tests.scene.railway import World, arch
from tests.scene.shapes import PLACE

L = 26.0
SPACED = np.arange(0.3, L - 0.2, 0.6)
PROUD = [*railway.sleepers(SPACED, 0.22), *railway.rails(L, 0.23)]
BALLASTED = [
    box
    for aside in (-2.1, 2.1)
    for box in [
        (0.0, L, aside - 1.6, aside + 1.6, 0.0, 0.14),
        *railway.sleepers(SPACED, 0.22, aside),
        *railway.rails(L, 0.23, aside),
    ]
]
DRAINED = np.concatenate([arch(5.5, 6.0, 3.2), [(-0.25, 0), (-0.25, -0.3), (0.25, -0.3), (0.25, 0)]])
SCANS = {
    "vlp16": lambda world: world.scan(railway.vlp16(), railway.carried(world.length, 1.5, 0.5), 0.012),
    "os1": lambda world: world.scan(railway.os1(), railway.carried(world.length, 1.2, 0.8), 0.012),
    "terrestrial": lambda world: world.scan(railway.terrestrial(), railway.stations(world.length), 0.004),
}


def built(world: World, points: np.ndarray, voxel: float) -> tuple[Bore, np.ndarray]:
    """The bore, and how much its floor on the axis lies too high at each station, m."""
    cloud = thin(points, voxel)
    bore = fitted(cloud, world.middle)[0]
    foot = bore.position - bore.toward(-np.pi / 2)[:, None] * bore.up + cloud.origin - PLACE
    return bore, foot[:, 2] - 0.01 * foot[:, 0]


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("world", "sensor"),
    [
        (World(arch(5.1, 5.5, 3.0), L, PROUD), "vlp16"),
        pytest.param(World(arch(5.1, 5.5, 3.0), L, PROUD), "os1", marks=SLOW),
        pytest.param(World(arch(5.1, 5.5, 3.0), L, PROUD), "terrestrial", marks=SLOW),
        pytest.param(World(arch(8.7, 6.6, 3.0), L, BALLASTED), "vlp16", marks=SLOW),
        (World(arch(8.7, 6.6, 3.0), L, BALLASTED), "terrestrial"),
        (World(arch(9.6, 7.0, 4.0), L, [(0, L, 3.8, 4.8, 0, 0.2), (0, L, -4.8, -3.8, 0, 0.2)]), "terrestrial"),
        pytest.param(World(arch(5.5, 6.0, 3.2), L, [(0, L, 1.75, 2.75, 0, 0.9)]), "vlp16", marks=SLOW),
        (World(arch(8.5, 6.0, 3.2), L, [(0, L, 1.75, 4.25, 0, 1.05)]), "terrestrial"),
        (World(DRAINED, L), "terrestrial"),
    ],
    ids=["proud-vlp16", "proud-os1", "proud", "double-vlp16", "double", "kerbs", "walkway", "platform", "drain"],
)
def test_floor_and_height_are_right_under_track_and_beside_walkways(world, sensor):
    bore, error = built(world, SCANS[sensor](world), 0.07 if sensor == "terrestrial" else 0.04)
    keep(bore)
    within = slice(8, -8)  # a carried scanner sees no floor at a mouth
    assert np.abs(error[within]).max() < 0.03
    assert np.median(bore.height) == pytest.approx(world.outline[:, 1].max(), abs=0.03)
    assert np.median(bore.width) == pytest.approx(np.ptp(world.outline[:, 0]), abs=0.03)


def test_sleepers_that_stand_out_little_do_not_lift_the_ballast():
    low = [box for aside in (-2.0, 2.0) for box in railway.sleepers(SPACED, 0.06, aside)]
    world = World(arch(8.7, 6.6, 3.0), L, low)
    bore, error = built(world, SCANS["os1"](world), 0.04)
    keep(bore)
    assert abs(np.median(error[8:-8])) < 0.008


def test_a_thin_cloud_shows_the_floor_between_sleepers_in_longer_windows():
    world = World(arch(5.1, 5.5, 3.0), L, PROUD)
    points = SCANS["terrestrial"](world)
    thin = points[np.random.default_rng(3).permutation(len(points))[:5_000]]  # 10 a square metre
    bore, error = built(world, thin, 0.07)
    keep(bore)
    assert np.abs(error[8:-8]).max() < 0.03


def test_ghosts_of_a_walker_do_not_lift_the_floor():
    world, rng = World(arch(5.5, 6.0, 3.2), L), np.random.default_rng(1)
    points = SCANS["vlp16"](world)
    count = int(0.12 * len(points))
    x = rng.uniform(0, L, count)
    ghosts = np.column_stack([x, rng.normal(0, 0.25, count), rng.uniform(0.1, 1.8, count) + 0.01 * x]) + PLACE
    bore, error = built(world, np.concatenate([points, ghosts]), 0.04)
    keep(bore)
    assert np.abs(error).max() < 0.03


def test_the_floor_runs_on_straight_under_a_train_and_through_a_gap():
    train = World(arch(5.5, 6.0, 3.2), 40.0, [(14, 26, -1.3, 1.3, 0.3, 3.7)])
    beside = railway.stations(40.0) - [0.0, 2.0, 0.0]
    for points in (
        train.scan(railway.terrestrial(), beside, 0.004),
        SCANS["terrestrial"](World(arch(5.5, 6.0, 3.2), 40.0, hole=(14.0, 24.0))),
    ):
        bore, error = built(train, points, 0.07)
        keep(bore, f" {len(points)}")
        assert np.abs(error).max() < 0.05


def test_a_walkway_stays_beside_the_floor_and_what_stands_there_for_a_metre_goes():
    kerbed, boxed = (
        built(world, SCANS["terrestrial"](world), 0.07)[0]
        for world in (World(arch(9.6, 7.0, 4.0), L, [(*along, 3.8, 4.8, 0, 0.2)]) for along in ((0, L), (12, 13)))
    )

    def foot(bore: Bore) -> float:
        """Height above the floor 4.3 m aside, on the higher side, m."""
        middle = bore.radius[len(bore.station) // 2]
        y, z = middle * np.cos(bore.angle), middle * np.sin(bore.angle)
        return max(float(np.interp(4.3, side * y[z < 0][::side], z[z < 0][::side])) for side in (1, -1)) - z.min()

    assert foot(kerbed) == pytest.approx(0.2, abs=0.03)
    assert foot(boxed) == pytest.approx(0.0, abs=0.03)


def test_a_round_invert_is_no_floor():
    turn = np.linspace(-np.pi, np.pi, 200)[:-1]
    tube = World(np.column_stack([2.7 * np.cos(turn), 2.7 + 2.7 * np.sin(turn)]), L)
    cloud = thin(SCANS["vlp16"](tube))
    sections = fit_sections(cloud, straight(cloud, tube.middle))
    keep(sections)
    assert not sections.flat_floor


@pytest.mark.parametrize(("plateau", "lower"), [(0.0, False), (0.02, False), (0.22, True)])
def test_a_lower_floor_is_one_that_lies_well_below_the_first(plateau, lower):
    rng = np.random.default_rng(2)
    across = rng.uniform(-2.6, 2.6, 4000)
    low = np.where(np.abs(across) < 1.3, plateau - 2.0, -2.0) + rng.normal(0.0, 0.004, 4000)
    found = floor.find_lower_line(across, low, (plateau - 2.0, 0.0))
    assert (found is not None) == lower
    assert not lower or found[0] == pytest.approx(-2.0, abs=0.01)


def bedded(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Station, lateral and upward place of a bore whose floor sways, and drops by 2 m beside a bed from 20 to 40 m."""
    station = rng.uniform(0.0, 60.0, count)
    lateral = rng.uniform(-2.7, 4.5, count)
    pit = (station > 20.0) & (station < 40.0) & (lateral > 1.0)
    inside = (lateral < 2.7) | pit
    upward = np.where(pit, -4.9, -2.8) + 0.04 * np.sin(2 * np.pi * station / 25.0) + rng.normal(0, 0.004, count)
    turn = rng.uniform(0.0, np.pi, count)
    walls = np.stack([station, 2.7 * np.cos(turn), 2.7 * np.sin(turn)])
    return tuple(np.concatenate([np.stack([station, lateral, upward])[:, inside], walls], axis=1))


def test_the_floor_goes_on_beside_a_pit_and_is_not_guessed_across_it():
    floors = floor.find_floors(*bedded(np.random.default_rng(7), 200_000), 0.0, 60.0)
    keep(floors)
    inner = (floors.station > 2.0) & (floors.station < 58.0)
    true = -2.8 + 0.04 * np.sin(2 * np.pi * floors.station / 25.0)
    assert np.abs(floors.height - true)[inner].max() < 0.01
