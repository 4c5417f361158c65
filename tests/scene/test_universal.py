"""Universal rings by standard: pockets at the radial joints, which turn from ring to ring."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from scene.bore import Bore
from scene.fitting.lining import (
    N_PLACES,
    PLACE,
    LiningConfig,
    add_standard_lining,
    draw_places,
    joints_by_number,
    radial_joints,
)
from scene.fitting.rings import bore_from_rings, fit_rings
from scene.reading.formats import detect
from scene.reading.ringsurvey import read_ring_survey
from scene.writing.planar import ring_pitch
from tests.scene.test_rings import survey_text
from tests.shared import METRO, needs_metro

UNIVERSAL = LiningConfig(lay="standard", kind="universal", seed=3)


def surveyed(text: str, folder) -> tuple[Bore, np.ndarray]:
    (folder / "s.csv").write_text(text)
    fit = fit_rings(read_ring_survey(detect(folder).path))
    bore = bore_from_rings(fit, np.floor(fit.centre[0]))
    return bore, joints_by_number(fit.names, bore.ring_station)


@pytest.fixture
def lined(tmp_path):
    bore, joints = surveyed(survey_text(count=60), tmp_path)
    return add_standard_lining(bore, UNIVERSAL, False, joints)


def find_unturned(bore: Bore) -> int:
    """Rings whose pockets stand where those of the ring before do."""
    station = np.unique(bore.pocket["station"])
    rings = [np.sort(np.round(bore.pocket["angle"][bore.pocket["station"] == s], 6)) for s in station]
    return sum(len(a) == len(b) and np.allclose(a, b) for a, b in itertools.pairwise(rings))


def test_the_segments_of_a_ring_make_one_turn_with_joints_between_bolts():
    joints = np.sort(radial_joints(0, 1)[0])
    spans = np.degrees(np.diff(joints, append=joints[0] + 2 * np.pi))
    np.testing.assert_allclose(np.sort(spans), [22.5, *[67.5] * 5])
    turned = np.mod(radial_joints(0, 40) - joints[0], PLACE)
    np.testing.assert_allclose(np.minimum(turned, PLACE - turned), 0.0, atol=1e-12)


def test_no_radial_joint_goes_on_into_the_next_ring_and_every_place_is_used():
    places = draw_places(np.random.default_rng(1), 4000)
    segment = {0, 3, 6, 9, 12, 15}
    for a, b in itertools.pairwise(places):
        assert not {(a + k) % N_PLACES for k in segment} & {(b + k) % N_PLACES for k in segment}
    assert np.bincount(places, minlength=N_PLACES).min() > 0.8 * 4000 / N_PLACES


def test_pockets_stand_at_either_side_of_the_radial_joints_in_the_middle_of_rings(lined):
    bore, provenance = lined
    middle = 0.5 * (bore.ring_joint[1:] + bore.ring_joint[:-1])
    joint = radial_joints(3, len(middle))
    for pocket in bore.pocket:
        ring = int(np.argmin(np.abs(middle - pocket["station"])))
        assert abs(middle[ring] - pocket["station"]) < 1e-6
        off = np.abs(np.angle(np.exp(1j * (joint[ring] - pocket["angle"])))).min() * bore.radius.mean()
        assert off == pytest.approx(UNIVERSAL.pocket_offset, abs=1e-6)
    assert len(bore.pocket) > 8 * len(middle)  # of twelve, those in the filled invert left out
    assert np.sin(bore.pocket["angle"]).min() > -np.sin(UNIVERSAL.filled_angle)
    assert not bore.pocket["measured"].any()
    assert provenance["pockets"] == "by standard, turns drawn with seed 3"
    assert not len(bore.nail)


def test_no_ring_stands_as_the_one_before(lined):
    assert find_unturned(lined[0]) == 0


def test_ring_numbers_tell_the_rings_between(tmp_path):
    lines = survey_text(count=31).splitlines()
    some = [line for line in lines[1:] if int(line.split(".")[0]) % 5 == 0]
    bore, joints = surveyed("\r\n".join([lines[0], *some]) + "\r\n", tmp_path)
    np.testing.assert_allclose(joints, 0.75 + 1.5 * np.arange(30), atol=1e-3)
    made, provenance = add_standard_lining(bore, UNIVERSAL, False, joints)
    assert ring_pitch(made) == 1.5
    assert len(made.ring_station) == 7  # those surveyed
    assert provenance["rings"] == "measured, those between by their numbers"


@pytest.mark.parametrize("names", [["a", "b", "c", "d"], ["1", "3", "2", "4"], ["1", "1", "2", "3"], ["1", "2", "3"]])
def test_names_that_tell_no_numbers_give_rings_of_the_standard_width(names, tmp_path):
    station = 7.0 * np.arange(len(names))
    assert not len(joints_by_number(names, station))
    bore, _ = surveyed(survey_text(), tmp_path)
    made, _ = add_standard_lining(bore, replace(UNIVERSAL, ring_width=2.0), False, joints_by_number(names, station))
    np.testing.assert_allclose(np.diff(made.ring_joint), 2.0)


@needs_metro
def test_the_rings_of_the_metro_are_those_that_are_packaged():
    import subterra_jax as st

    fit = fit_rings(read_ring_survey(detect(METRO).path))
    bore = bore_from_rings(fit, np.floor(np.median(fit.centre, axis=0)))
    joints = joints_by_number(fit.names, bore.ring_station)
    made, _ = add_standard_lining(bore, LiningConfig(lay="standard", kind="universal"), False, joints)
    packaged = st.load_tunnel("metro").shell.linings["pockets"].pocket
    columns = [made.pocket[name] for name in ("station", "angle", "length", "width", "depth")]
    np.testing.assert_allclose(np.column_stack(columns), packaged, atol=1e-4)
