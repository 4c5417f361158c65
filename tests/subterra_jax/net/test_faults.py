"""Faults: docs/tasks.md, "Faults (T4)"."""

import numpy as np
import pytest

from tests.subterra_jax.net.robots import MANY, advanced, assert_mean, begun, driven, observed, placed

FROZEN = 0.1  # m counted in a step of 0.2 m; below it the wheels seem to stand


@pytest.fixture(scope="module")
def faulted():
    """States of 3,000 robots under faults after 35 s, severities, and series of the whole drive."""
    id = "Subterra/Faulted-v1"
    start = begun(id, MANY)
    severity = np.asarray(advanced(id, start, np.zeros(2))[4]["severity"])
    state, series = driven(id, placed(id, start, 40.0), 350)
    return state, severity, series


def test_every_severity_is_drawn_alike(faulted):
    share = np.bincount(faulted[1].astype(int), minlength=5) / MANY
    assert len(share) == 5
    assert np.abs(share - 0.2).max() < 4.0 * np.sqrt(0.2 * 0.8 / MANY)


def test_30_percent_of_the_patches_are_wet_at_severity_4_and_take_30_percent_of_the_speed(faulted):
    _, severity, series = faulted
    ratio, patch = series["moved"] / 0.2, np.floor(series["station"] / 10.0).astype(int)
    losses = []
    for level in range(5):
        wet = []
        # At the end of the drive everybody has left these four patches.
        for k in range(4, 8):
            there = (patch == k)[:, severity == level]
            slow = (ratio[:, severity == level] < 0.85) & there
            share = slow.sum(axis=0) / there.sum(axis=0)
            # A patch is wet or dry as a whole.
            assert set(np.unique(share)) <= {0.0, 1.0}
            wet.append(share)
            losses.extend(ratio[:, severity == level][slow][::7])
        expected, wet = 0.3 * level / 4, np.concatenate(wet)
        assert abs(wet.mean() - expected) <= 4.0 * np.sqrt(expected * (1.0 - expected) / len(wet)), level
    assert np.mean(losses) == pytest.approx(0.7, abs=0.003)
    # The odometer turns with the wheels: it does not notice.
    slow = (ratio < 0.85) & (series["counted"] > FROZEN)
    assert np.mean(series["counted"][slow]) == pytest.approx(0.2, abs=0.003)


def test_the_odometer_freezes_1_percent_of_the_steps_for_up_to_3_seconds_at_severity_4(faulted):
    _, severity, series = faulted
    for level in range(5):
        frozen = series["counted"][:, severity == level] < FROZEN
        begins = frozen[1:] & ~frozen[:-1]
        chances, rate = (~frozen[:-1]).sum(), 0.01 * level / 4
        assert abs(begins.sum() - rate * chances) <= 4.0 * np.sqrt(rate * chances), level
        if level == 4:
            # Runs that begin in time to end within the drive: whole steps, as often 1 as 30.
            begin = [(k, i) for k, i in zip(*np.nonzero(begins), strict=True) if k < 300]
            lengths = [np.argmin(np.append(frozen[k + 1 :, i], False)) for k, i in begin]
            assert max(lengths) == 30
            assert_mean(lengths, 15.5)


def test_observations_are_as_old_as_the_severity(faulted):
    state, severity, series = faulted
    distance = np.cumsum(series["counted"], axis=0)
    age = np.round(2.4 * severity / 4.0).astype(int)
    late = distance[-1 - age, np.arange(MANY)] + np.asarray(state.faults.origin)[:, 0]
    np.testing.assert_allclose(observed("Subterra/Faulted-v1", state)["odometry"][:, 0], late, atol=1e-3)


def test_dust_takes_15_percent_of_the_beams_at_severity_4_somewhere_before_the_wall(faulted):
    state, severity, _ = faulted
    scans = np.stack([observed("Subterra/Faulted-v1", state, key)["ranges"] for key in range(9)])
    wall = np.median(scans, axis=0)
    # Only beams that are there, and whose median is the wall even where a few of the nine meet dust.
    clear = (wall < 25.0) & (wall > 1.0)
    short = scans < wall - 0.25
    for level in range(5):
        mine = clear & (severity == level)[:, None]
        share = np.where(mine, short.mean(axis=0) / (1.0 - 0.25 / np.maximum(wall, 1.0)), 0.0).sum(axis=1) / mine.sum(
            axis=1
        ).clip(1)
        share = share[(severity == level) & (mine.sum(axis=1) > 0)]
        if level == 0:
            assert not share.any()
        else:
            assert np.mean(share) == pytest.approx(0.15 * level / 4, rel=0.06), level


def test_sectors_of_up_to_8_beams_drop_out_for_up_to_4_seconds(faulted):
    state, severity, _ = faulted
    id = "Subterra/Faulted-v1"
    plain = begun("Subterra/StopAt-v1", MANY)
    out, beams = np.zeros((MANY, 16)), np.zeros((MANY, 16))
    largest = 0
    for k in range(3):
        state, _ = driven(id, state, 50, key=10 + k)
        # Where the delayed scan is taken differs from where the robot is by less than a metre.
        there = plain.replace(position=state.position, heading=state.heading, station=state.station)
        hits = observed("Subterra/StopAt-v1", there)["ranges"] < 20.0
        gone = (observed(id, state)["ranges"] == 30.0) & hits
        out, beams = out + gone, beams + hits
        largest = max(largest, gone.sum(axis=1).max())
    assert 7 <= largest <= 8
    for level in range(5):
        mine = severity == level
        share = out[mine].sum(axis=1) / beams[mine].sum(axis=1)
        if level == 0:
            assert not share.any()
            continue
        # Out for 1 to 40 steps and back until the next time; 1 to 8 of 16 beams.
        rate = 0.02 * level / 4
        assert_mean(share, 20.5 / (20.5 + 1.0 / rate) * 4.5 / 16.0)
