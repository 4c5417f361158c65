"""Metrics whose value on a tube of known dimensions is known, and what spoils them."""

from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest
import trimesh

from benchmarks.fidelity import table
from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.categories import scene as scene_metrics
from benchmarks.fidelity.derive.beams import returns
from tests.benchmarks.fidelity import tube, tubescene
from tests.benchmarks.fidelity.judged import SHORT, against, judged, measure, raw
from tests.benchmarks.fidelity.tube import Tube

SIGMA = 0.02  # m, of the recording's ranges
short = partial(against, SHORT)


def score(id: str, case: Case) -> float:
    return table.load()[id].map.score(raw(id, case))


def test_a_tube_10_cm_aside_is_registered_by_10_cm() -> None:
    assert raw("cl_icp_translation", judged()) < 0.03
    assert raw("cl_icp_translation", judged(shift=(0.1, 0.0))) == pytest.approx(0.1, abs=0.03)


def test_a_tube_10_cm_too_high_has_that_error_of_height() -> None:
    assert raw("sec_height_rmse", judged()) < 1e-6
    assert raw("sec_height_rmse", judged(height=6.3)) == pytest.approx(0.1, abs=2e-3)
    assert score("sec_height_rmse", judged(height=6.3)) < score("sec_height_rmse", judged())


def test_a_constant_tube_misses_the_area_by_twice_the_variation() -> None:
    constant = judged(variation=0.0)
    assert raw("sec_area_rel_err_mean", judged()) < 1e-6
    assert raw("sec_area_rel_err_mean", constant) == pytest.approx(100 * 2 * 0.006 * 2 / np.pi, abs=0.1)
    assert raw("sec_area_rel_err_p95", judged()) < 1e-6
    assert raw("sec_area_rel_err_p95", constant) == pytest.approx(100 * 2 * 0.006, abs=0.1)


def test_distances_to_the_right_tube_are_noise_and_to_a_wide_one_are_not() -> None:
    wide = judged(width=5.8)  # walls 10 cm out
    assert raw("c2m_p95", judged()) < raw("c2m_p99", judged()) < 2.6 * SIGMA
    assert raw("c2m_p99", wide) > 0.1
    assert raw("c2m_within_5cm", judged()) > 0.98
    assert raw("c2m_within_5cm", wide) < 0.75
    assert score("c2m_within_5cm", wide) < score("c2m_within_5cm", judged())


def test_range_differences_in_the_right_tube_have_the_quantiles_of_the_noise() -> None:
    noise = np.abs(np.random.default_rng(3).normal(scale=SIGMA, size=len(returns(judged()).range)))
    assert raw("beam_range_p95", judged()) == pytest.approx(1.96 * SIGMA, rel=0.05)
    assert raw("beam_rel_medae", judged()) == pytest.approx(100 * np.median(noise / returns(judged()).range), rel=0.05)
    assert raw("beam_range_p95", judged(width=5.8)) > 0.1
    assert raw("beam_rel_medae", judged(width=5.8)) > 2 * raw("beam_rel_medae", judged())


def test_a_pillar_is_a_loop_that_the_other_diagram_has_not() -> None:
    turn = np.eye(4)
    turn[:3, :3] = np.column_stack([axis[0] for axis in SHORT.frames(6.1)[1:]])
    turn[:3, 3] = SHORT.point(6.1, 0.0, 0.0)[0]
    pillar = trimesh.creation.box((0.4, 0.4, 8.0), transform=turn)
    assert raw("topo_bottleneck_h1", short()) == pytest.approx(0.0, abs=1e-9)
    assert raw("topo_bottleneck_h1", tube.spoiled(short(), extra=pillar)) > 0.3


def test_rails_10_cm_farther_out_give_the_way_10_cm_more_room() -> None:
    wider = short(gauge=SHORT.gauge + 0.2)
    for id in ("nav_clearance_min_err", "nav_clearance_mean_err"):
        assert raw(id, short()) == 0.0
        assert raw(id, wider) == pytest.approx(0.1, abs=0.02)
        assert score(id, wider) < score(id, short())
    inner = SHORT.gauge / 2
    assert inner - 0.40 - 0.15 < raw("nav_footprint_margin", short()) < inner - 0.40
    gain = raw("nav_footprint_margin", wider) - raw("nav_footprint_margin", short())
    assert gain == pytest.approx(0.1, abs=0.02)


def test_a_floor_with_steps_everywhere_has_another_95th_percentile() -> None:
    assert raw("nav_step_p95_err", short()) == 0.0
    blocks = [trimesh.creation.box((0.15, 6.0, 0.12)) for _ in range(12)]
    for k, block in enumerate(blocks):
        block.apply_translation(SHORT.point(0.7 + 0.9 * k, 0.0, float(SHORT.floor(0.7 + 0.9 * k)) + 0.1)[0])
    rough = tube.spoiled(short(track=False), extra=trimesh.util.concatenate(blocks))
    assert raw("nav_step_p95_err", rough) > 0.02
    assert score("nav_step_p95_err", rough) < score("nav_step_p95_err", short())


def test_rows_of_pockets_lie_as_far_apart_as_the_reference_s_and_without_pockets_nowhere() -> None:
    assert raw("lin_circ_pitch_err", judged()) < 1.0
    assert raw("lin_circ_pitch_err", judged(depth=0.0)) == 100.0


def test_nails_are_counted_by_pairs_of_pockets_on_either_side_of_a_joint() -> None:
    case = short()
    value = measure("lin_nail_count_ratio", case)
    joints = np.sum((SHORT.joints > 0.4) & (SHORT.joints < SHORT.length - 0.4))
    assert value.n == 6 * joints
    assert value.value == 0.0
    nailed = tube.spoiled(case, manifest={**case.candidate.manifest, "count": {"nails": 3 * int(joints)}})
    assert raw("lin_nail_count_ratio", nailed) == pytest.approx(0.5)


def test_a_rail_that_rises_2_mm_a_metre_over_the_other_is_that_much_twist() -> None:
    case = tube.case(replace(SHORT, bend=np.inf, grade=0.0, variation=0.0))
    track = case.candidate.track
    assert raw("trk_twist_p95", case) < 0.05
    left = track.rail["left"].copy()
    left[:, 2] += 0.002 * np.linalg.norm(left - left[0], axis=1)
    twisted = tube.spoiled(case, track=replace(track, rail={**track.rail, "left": left}))
    assert raw("trk_twist_p95", twisted) == pytest.approx(2.0, abs=0.1)


@pytest.fixture(scope="module")
def released(tmp_path_factory) -> Case:
    return Case(load_candidate(tubescene.write(tmp_path_factory.mktemp("known") / "tube", Tube(length=6.0))))


def test_a_mujoco_that_the_project_does_not_ask_for_fails(released, monkeypatch) -> None:
    assert raw("mj_version_match", released) == 1.0
    monkeypatch.setattr(mujoco, "__version__", "2.3.7")
    assert raw("mj_version_match", released) == 0.0


def test_a_geom_that_a_round_trip_moves_by_a_centimetre_fails(released, monkeypatch) -> None:
    assert raw("mj_xml_roundtrip", released) == 1.0
    read = mujoco.MjSpec.from_string

    class Careless:
        """Reads like `MjSpec` and shifts the first geom."""

        from_file = staticmethod(mujoco.MjSpec.from_file)

        @staticmethod
        def from_string(text: str, assets: dict[str, bytes]) -> mujoco.MjSpec:
            spec = read(text, assets=assets)
            spec.worldbody.geoms[0].pos = np.add(spec.worldbody.geoms[0].pos, [0.01, 0.0, 0.0])
            return spec

    monkeypatch.setattr(scene_metrics.mujoco, "MjSpec", Careless)
    value = measure("mj_xml_roundtrip", released)
    assert value.value == 0.0
    assert value.reason == "moved by 1.0e-02"
