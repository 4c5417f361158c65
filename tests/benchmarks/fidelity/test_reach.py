"""Recordings of another frame or of a part, tunnels shorter than a window: one sentence each."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.inputs import check_length, check_recording
from tests.benchmarks.fidelity import tube

SCENE, BAG = Path("tunnel"), Path("held.bag")
LONG = tube.Tube(length=48.0)


def test_a_recording_of_the_whole_tunnel_in_its_frame_passes() -> None:
    check_recording(tube.candidate(), tube.hold(tube.Tube(), beams=2000), SCENE, BAG)


def test_a_recording_in_another_frame_is_refused() -> None:
    hold = tube.hold(tube.Tube(), beams=2000)
    away = replace(hold, origin=hold.origin + np.array([300.0, 40.0, 0.0]), cache={})
    with pytest.raises(FidelityError, match=r"held.bag: its sensor lies 29\d m from the tunnel of tunnel"):
        check_recording(tube.candidate(), away, SCENE, BAG)


def test_a_recording_of_a_part_is_refused_unless_that_is_asked_for() -> None:
    hold = tube.hold(LONG, beams=2000)
    station = tube.candidate(LONG).bore.station
    points = hold.origin + hold.range[:, None] * hold.direction
    end = tube.candidate(LONG).bore.position[np.searchsorted(station, 24.0)]
    ahead = tube.candidate(LONG).bore.tangent[0]
    kept = ((points - end) @ ahead < 0.0) & ((hold.origin - end) @ ahead < 0.0)
    names = ("time", "scan", "origin", "direction", "range")
    half = replace(hold, **{name: getattr(hold, name)[kept] for name in names}, cache={})
    with pytest.raises(FidelityError, match=r"held.bag: shows 2\d of the 48 m of tunnel, nothing for instance at stat"):
        check_recording(tube.candidate(LONG), half, SCENE, BAG)
    check_recording(tube.candidate(LONG), half, SCENE, BAG, partial=True)


def test_a_tunnel_shorter_than_a_window_is_refused() -> None:
    with pytest.raises(FidelityError, match=r"tunnel: its tunnel is 8\.0 m long, and a window along it 10 m"):
        check_length(tube.candidate(tube.Tube(length=8.0)), SCENE)
    check_length(tube.candidate(), SCENE)
