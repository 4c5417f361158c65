"""What is no single bore is refused by place and cause; what belongs to one passes."""

import re

import numpy as np
import pytest

from scene.bore import Bore
from scene.errors import FitError, Refusal
from tests.scene.fits import bore_about, cleaned, thin
from tests.scene.shapes import PLACE, Box, Tube, cavity, placed

MAIN = Tube((0, 0), (50, 0))
ORIENTATIONS = [(0.0, 0.0), (1.1, 0.12), (-2.4, -0.08)]
JUNCTIONS = {
    "T": (MAIN, Tube((25, 0), (25, 20))),
    "short T": (MAIN, Tube((25, 0), (25, 10))),
    "Y": (Tube((0, 0), (60, 0)), Tube((25, 0), (51, 15))),
    "crossing": (MAIN, Tube((25, -20), (25, 20))),
    "room on the way": (MAIN, Box((18, -7), (32, 7), 7)),
}


def fitted(points: np.ndarray, strict: bool = True) -> Bore:
    bore = cleaned(thin(points), strict)
    return bore_about(bore.axis, bore.cloud)


@pytest.mark.parametrize(
    ("name", "yaw", "tilt"),
    [("T", *ORIENTATIONS[0]), ("T", *ORIENTATIONS[1]), ("short T", *ORIENTATIONS[0]), ("Y", *ORIENTATIONS[1]),
     ("crossing", *ORIENTATIONS[1]), ("room on the way", *ORIENTATIONS[0])],
)  # fmt: skip
def test_a_branch_or_a_room_is_refused_with_its_place_in_the_frame_of_the_input(name, yaw, tilt):
    with pytest.raises(FitError) as raised:
        fitted(cavity(*JUNCTIONS[name], yaw=yaw, tilt=tilt))
    assert raised.value.code == Refusal.BRANCH
    told = re.search(r"near \((\S+), (\S+), (\S+)\)", str(raised.value))
    there = placed(np.array([[25.0, 0.0, 2.5]]), yaw, tilt)[0]
    assert np.linalg.norm(np.array([float(value) for value in told.groups()]) - there) < (18.0 if name == "Y" else 8.0)


def test_a_tunnel_that_ends_in_a_crossing_one_is_refused_at_its_end():
    with pytest.raises(FitError) as raised:
        fitted(cavity(MAIN, Tube((50, -20), (50, 20))))
    assert raised.value.code == Refusal.BRANCH
    x = float(re.search(r"near \((\S+),", str(raised.value)).group(1))
    assert abs(x - PLACE[0] - 50) < 8.0


@pytest.mark.parametrize("room", [Box((0, 0), (12, 10), 4), Box((0, 0), (40, 30), 6)])
def test_a_room_alone_is_refused(room):
    with pytest.raises(FitError) as raised:
        fitted(cavity(room, yaw=0.4))
    assert raised.value.code == Refusal.ROOM


def test_an_open_field_is_refused():
    rng = np.random.default_rng(0)
    plan = rng.uniform(0, 60, (120_000, 2))
    with pytest.raises(FitError) as raised:
        fitted(np.column_stack([plan, np.sin(plan[:, 0] / 5) + np.cos(plan[:, 1] / 7)]))
    assert raised.value.code in (Refusal.NO_BORE, Refusal.OPEN, Refusal.PLANE, Refusal.ROOM)


@pytest.mark.parametrize(("yaw", "tilt"), ORIENTATIONS[1:])
def test_a_niche_and_a_passage_are_cut_off(yaw, tilt):
    niche, door = Box((20, 0), (23, 4.5), 2.5), Tube((35, 0), (35, 8), 1.8, 2.2)
    bore = fitted(cavity(MAIN, niche, door, yaw=yaw, tilt=tilt), strict=False)
    assert bore.length == pytest.approx(50, abs=1.3)  # the mouths are cut aslant
    assert np.median(bore.width) == pytest.approx(5.0, abs=0.03)


@pytest.mark.parametrize("length", [4.0, 10.0])
def test_a_gap_in_the_survey_is_no_end(length):
    points = cavity(MAIN)
    along = points[:, 0] - PLACE[0]
    bore = fitted(points[np.abs(along - 25) > length / 2])
    assert bore.length == pytest.approx(50, abs=0.3)
    assert np.abs(bore.width - 5.0).max() < 0.3
    in_gap = np.abs(bore.station - 25) < 1.0
    assert bore.filled[in_gap].all()
    assert bore.confidence[in_gap].max() < bore.confidence[~bore.filled].min()


def test_a_portal_that_flares_open_is_no_room():
    points = cavity(MAIN) - PLACE
    flare = 1 + 0.12 * np.maximum(points[:, 0] - 45, 0)
    points[:, 1:] *= flare[:, None]
    bore = fitted(points + PLACE)
    assert bore.length == pytest.approx(50, abs=1.5)
    assert bore.width.max() > 7.0
