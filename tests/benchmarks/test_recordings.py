"""Conventions drawn at random: each is one that a driver can write, and its reading is judged against the truth."""

from collections import Counter
from dataclasses import replace

import numpy as np

from benchmarks import recordings
from benchmarks.recordings import compare, draw_case
from tests.scene.conftest import arc_bore


def test_every_kind_is_drawn_and_the_same_number_draws_the_same():
    cases = [draw_case(np.random.default_rng([0, k])) for k in range(300)]
    assert cases[7] == draw_case(np.random.default_rng([0, 7]))
    for case in cases:
        case.convention.check()
    for name, odds in recordings._ODDS.items():
        drawn = Counter(getattr(case.convention, name) for case in cases)
        assert set(drawn) == set(odds), name
    assert {(case.sensor, case.beside) for case in cases} == {
        (sensor, beside) for sensor in ("vlp16", "avia") for beside in ("trajectory", "IMU")
    }


def test_bores_are_compared_where_both_have_walls():
    bore = arc_bore()
    assert compare(bore, bore) == (0.0, 0.0)
    assert compare(bore, replace(bore, radius=1.01 * bore.radius))[0] > 0.02
