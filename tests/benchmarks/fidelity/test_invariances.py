"""What must not move the scores keeps what it should keep."""

import numpy as np
import pytest

from benchmarks.fidelity import table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults import Site, put_in
from benchmarks.fidelity.faults.kinds import load_controls
from benchmarks.fidelity.registry import compute_metric
from tests.benchmarks.fidelity import tube

WATCHED = ("c2m_mean", "beam_range_mae", "cl_lateral_rmse", "sec_width_rmse", "mesh_orientation_frac", "trk_sleeper_f1")


@pytest.fixture(scope="module")
def base() -> Case:
    return tube.case(tube.Tube(bend=80.0))


def scores(case: Case) -> dict[str, float | None]:
    rows = table.load()
    return {id: rows[id].map.score(compute_metric(case, rows[id]).value or 0.0) for id in WATCHED}


INVARIANCES = {id: control for id, control in load_controls().items() if control.kind == "invariance"}


def changed(base: Case, control: str) -> Case:
    return put_in(Site(base), INVARIANCES[control].faults[0.0])


@pytest.mark.parametrize("control", INVARIANCES)
def test_an_invariance_is_quiet(base: Case, control: str) -> None:
    assert scores(changed(base, control)) == pytest.approx(scores(base), abs=INVARIANCES[control].limit)


def test_a_reversed_axis_starts_at_the_other_end(base: Case) -> None:
    turned = changed(base, "I4").candidate.bore
    np.testing.assert_allclose(turned.position[0], base.candidate.bore.position[-1])
    np.testing.assert_allclose(np.cross(turned.tangent, turned.lateral), turned.up, atol=1e-9)
    row, column = 7, 33
    point = turned.position[row] + turned.radius[row, column] * (
        np.cos(turned.angle[column]) * turned.lateral[row] + np.sin(turned.angle[column]) * turned.up[row]
    )
    old = base.candidate.bore
    away = point - old.position[-1 - row]
    angle = np.arctan2(away @ old.up[-1 - row], away @ old.lateral[-1 - row])
    expected = np.interp(angle, old.angle, old.radius[-1 - row], period=2 * np.pi)
    assert np.linalg.norm(away) == pytest.approx(expected, abs=1e-3)
