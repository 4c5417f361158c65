"""Pockets and nails are measured where they can be seen, by standard where not, and never invented."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from scene.bore import Bore
from scene.cloud import Cloud
from scene.fitting.lining import LiningConfig, add_lining, add_standard_lining, pair_pockets
from scene.fitting.section import fit_unfolded
from scene.fitting.unroll import fill_sides
from scene.geometry import axis_through
from tests.scene import railway
from tests.scene.fits import Line, bore_about, fitted, keep, thin
from tests.scene.railway import World, arch
from tests.scene.shapes import PLACE, midline, swept

RADIUS, LENGTH, RING = 2.75, 12.0, 1.5
LINE = (np.full(3, 40.0), np.array([40.0 + LENGTH, 40.0, 40.0]))
JOINTS = np.arange(0.75, LENGTH, RING)
ROWS = np.deg2rad([-30.0, 10.0, 50.0, 90.0, 130.0, 170.0, 210.0])
OFFSET, HALF, DEPTH, NAIL = 0.22, (0.10, 0.09), 0.13, 0.06


def lined(nails: bool) -> np.ndarray:
    """A round bore with recesses of known size, each pair bridged by a bolt of 28 mm, seen from everywhere."""
    rng = np.random.default_rng(1)
    station, angle = rng.random(470_000) * LENGTH, rng.uniform(-np.pi, np.pi, 470_000)
    radius = np.full(len(station), RADIUS)
    hole, bolt = np.zeros(len(station), bool), np.zeros(len(station), bool)
    for joint in JOINTS:
        for row in ROWS:
            around = RADIUS * np.angle(np.exp(1j * (angle - row)))
            for side in (-1, 1):
                along = station - joint - side * OFFSET
                inside = (np.abs(along) < HALF[0]) & (np.abs(around) < HALF[1])
                hole |= inside
                bolt |= inside & (np.abs(around) < 0.014) & (side * along < 0)
    radius[hole] += DEPTH
    if nails:
        radius[bolt] = RADIUS + NAIL - 0.011
    points = np.stack([station, radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return points + rng.normal(0, 0.004, points.shape) + 40.0


def built(
    points: np.ndarray, config: LiningConfig | None = None, line: Line | None = None
) -> tuple[Bore, dict[str, str], Cloud]:
    cloud = thin(points)
    return *add_lining(*fitted(cloud, line), cloud, config), cloud


@pytest.fixture(scope="module")
def with_nails():
    return built(lined(nails=True), line=LINE)


def test_pockets_are_measured_with_place_size_and_depth(with_nails):
    bore, provenance, _ = with_nails
    keep([bore, provenance])
    assert provenance["pockets"] == provenance["rings"] == "measured"
    assert len(bore.pocket) == pytest.approx(2 * len(JOINTS) * len(ROWS), rel=0.06)
    assert bore.pocket["measured"].all()
    apart = np.abs(np.angle(np.exp(1j * (bore.pocket["angle"][:, None] - np.concatenate([ROWS, np.pi - ROWS])))))
    assert np.quantile(apart.min(axis=1), 0.95) * RADIUS < 0.03
    assert bore.pocket["depth"].mean() == pytest.approx(DEPTH, abs=0.015)
    assert np.median(np.diff(bore.ring_station)) == pytest.approx(RING, abs=0.01)


def test_nails_are_seen_in_their_pockets(with_nails):
    bore, provenance, _ = with_nails
    assert provenance["nails"].startswith("measured")
    seen = bore.nail[bore.nail["measured"]]
    assert len(seen) > 0.9 * len(JOINTS) * len(ROWS)
    assert seen["depth"].mean() == pytest.approx(NAIL, abs=0.01)
    assert seen["length"].mean() == pytest.approx(2 * OFFSET, abs=0.03)
    off_joint = np.abs(seen["station"][:, None] - bore.ring_station).min(axis=1)
    assert np.quantile(off_joint, 0.95) < 0.05
    assert seen["confidence"].min() > 0.8


def test_every_pocket_is_joined_to_the_next_of_its_joint(bore):
    pairs = pair_pockets(bore, bore.ring_station)
    first, second = bore.pocket[pairs[:, 0]], bore.pocket[pairs[:, 1]]
    assert len(pairs) == len(bore.pocket) // 2  # each has one across its joint
    assert (np.abs(second["station"] - first["station"] - 0.4) < 1e-9).all()
    np.testing.assert_allclose(first["angle"], second["angle"])
    assert np.abs((first["station"] + second["station"])[:, None] / 2 - bore.ring_station).min(axis=1).max() < 1e-9
    assert pair_pockets(replace(bore, pocket=bore.pocket[:1])).shape == (0, 2)


def test_empty_pockets_have_no_nails():
    bore, provenance, _ = built(lined(nails=False), line=LINE)
    assert provenance["pockets"] == "measured"
    keep(bore)
    assert provenance["nails"] == "none found"
    assert not len(bore.nail)


def test_a_smooth_wall_seen_well_gets_nothing():
    bore, provenance, _ = built(swept("circle", 18, yaw=0.4, per_metre=9000), line=midline("circle", 18, yaw=0.4))
    keep(bore)
    assert set(provenance.values()) == {"none found"}
    assert not len(bore.pocket)
    assert not len(bore.ring_station)


def test_a_wall_seen_too_thinly_gets_the_standard_lining_on_request_marked_so(tmp_path):
    points = swept("circle", 30, yaw=0.4)
    sparse, line = points[::8], midline("circle", 30, yaw=0.4)
    bore, provenance, _ = built(sparse, LiningConfig(lay="standard"), line)
    keep(bore)
    assert provenance == {"rings": "by standard", "pockets": "by standard", "nails": "by standard"}
    assert len(bore.pocket) == 2 * 8 * len(bore.ring_station)
    assert len(bore.nail) == 8 * len(bore.ring_station)
    assert not bore.pocket["measured"].any()
    assert not bore.nail["measured"].any()
    assert (bore.pocket["depth"] == 0.13).all()
    np.testing.assert_allclose(np.diff(bore.ring_station), 1.5)
    bore.save(tmp_path / "bore.npz")
    with np.load(tmp_path / "bore.npz") as data:
        np.testing.assert_array_equal(data["nail"], bore.nail)


@pytest.mark.parametrize(
    ("lay", "railway", "some"),
    [("auto", False, False), ("auto", True, True), ("none", True, False), ("standard", False, True)],
)
def test_the_standard_lining_stands_in_a_railway_or_on_request(bore, lay, railway, some):
    round_bore = replace(bore, radius=np.full_like(bore.radius, 2.8), ring_station=np.empty(0), pocket=bore.pocket[:0])
    lined, provenance = add_standard_lining(round_bore, LiningConfig(lay=lay), False, railway=railway)
    assert (len(lined.pocket) > 0) == (len(lined.ring_station) > 0) == some
    assert provenance["pockets"] == ("by standard" if some else "none: the survey cannot show them")


def test_the_standard_lining_can_be_chosen():
    sparse = swept("circle", 30, yaw=0.4)[::8]
    chosen = LiningConfig(lay="standard", ring_width=2.0, pockets_per_ring=5, pocket_size=(0.25, 0.2))
    bore, _, _ = built(sparse, chosen, midline("circle", 30, yaw=0.4))
    assert np.diff(bore.ring_station) == pytest.approx(2.0)
    assert len(bore.pocket) == 10 * len(bore.ring_station)
    assert (bore.pocket["length"] == 0.25).all()
    assert len(bore.nail) == 5 * len(bore.ring_station)


def test_walls_too_irregular_for_segments_get_none_by_standard(bore):
    noise = gaussian_filter(np.random.default_rng(3).standard_normal(bore.radius.shape), (3.0, 10.0), mode="wrap")
    for rough, some in ((0.005, True), (0.13, False)):
        walls = replace(bore, pocket=bore.pocket[:0], ring_station=np.empty(0))
        walls = replace(walls, radius=bore.radius + rough * noise / noise.std())
        found, provenance = add_standard_lining(walls, LiningConfig(lay="standard"), flat_floor=True)
        assert (len(found.pocket) > 0) == some
        assert provenance["rings"] == ("by standard" if some else "none")


L = 18.0
ARCH = World(arch(5.5, 6.0, 3.2), L)


def test_a_gap_in_a_wall_is_closed_by_a_line_and_those_of_crown_and_floor_stay():
    angle = -np.pi + 2 * np.pi * (np.arange(120) + 0.5) / 120
    square = 2.0 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    for middle, known in ((0.0, True), (np.pi, True), (np.pi / 2, False), (-np.pi / 2, False)):
        unseen = np.abs(np.angle(np.exp(1j * (angle - middle)))) < np.deg2rad(30)
        filled = fill_sides(np.where(unseen, np.nan, square)[None], angle)[0]
        assert np.isfinite(filled[unseen]).all() == known
        np.testing.assert_allclose(filled[np.isfinite(filled)], square[np.isfinite(filled)], atol=1e-9)


def test_a_wall_goes_on_to_an_end_as_it_was_before_and_no_further_than_told():
    angle = -np.pi + 2 * np.pi * (np.arange(120) + 0.5) / 120
    square = 2.0 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    walls = np.repeat(square[None], 10, axis=0)
    gap = (angle > np.deg2rad(-60)) & (angle < np.deg2rad(50))  # from the floor, past both corners, to the ceiling
    walls[4:, gap] = np.nan
    line = fill_sides(walls, angle)[4:, gap]
    assert (square[gap] - line).max() > 0.5, "the line from floor to ceiling cuts the wall off"
    filled = fill_sides(walls, angle, 2)
    np.testing.assert_array_equal(filled[:6], np.repeat(square[None], 6, axis=0))
    np.testing.assert_array_equal(filled[6:, gap], line[2:])
    np.testing.assert_array_equal(fill_sides(walls[::-1], angle, 2), filled[::-1])
    walls[-1] = square  # seen again: no end
    np.testing.assert_array_equal(fill_sides(walls, angle, 2)[4:9, gap], line[:5])


def test_the_bore_keeps_its_width_where_a_scan_ends_aslant():
    points = ARCH.scan(railway.terrestrial(), railway.stations(L), 0.004) - PLACE
    unseen = (points[:, 1] > -1.0) & (points[:, 0] > L - 0.9 - 0.2 * points[:, 1])
    cloud = thin(points[~unseen] + PLACE, 0.07)
    bore, sections = fitted(cloud, ARCH.middle)
    keep([bore, sections])
    assert np.abs(bore.width - 5.5).max() < 0.03


def test_a_wall_that_nobody_saw_stands_straight_between_crown_and_floor():
    points = ARCH.scan(railway.terrestrial(), railway.stations(L), 0.004) - PLACE
    unseen = (points[:, 1] > 2.70) & (points[:, 2] - 0.01 * points[:, 0] < 3.2)
    cloud = thin(points[~unseen] + PLACE, 0.07)
    bore, sections = fitted(cloud, ARCH.middle)
    keep([bore, sections])
    assert np.abs(bore.width[8:-8] - 5.5).max() < 0.10


def test_an_axis_that_bends_so_sharply_that_sections_fold_is_smoothed():
    cloud = thin(ARCH.scan(railway.terrestrial(), railway.stations(L), 0.004), 0.07)
    along = np.arange(0.0, L + 0.1, 0.5)
    jump = 0.9 / (1.0 + np.exp((L / 2 - along) / 0.12))  # as at the end of a platform
    path = np.column_stack([along, jump - 0.4, 2.9 + 0.01 * along]) + PLACE - cloud.origin
    axis = axis_through(path, 0.25)
    assert bore_about(axis, cloud).find_fold() is not None
    _, bore = fit_unfolded(cloud, axis, 12.0)
    keep(bore)
    assert bore.find_fold() is None
    assert np.abs(bore.axis.curvature).max() < 0.3
    assert np.median(bore.width) == pytest.approx(5.5, abs=0.05)
