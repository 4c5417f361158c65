"""Metrics whose value on a tube of known dimensions is known, and what corrupts them."""

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
from benchmarks.fidelity.derive.lining import judged_pockets
from benchmarks.fidelity.windows.judge import worst_windows
from tests.benchmarks.fidelity import tube, tubescene
from tests.benchmarks.fidelity.judged import PLAIN, SHORT, against, measure, raw
from tests.benchmarks.fidelity.tube import Tube

short = partial(against, SHORT)


def test_every_pocket_of_a_true_copy_is_found_and_without_any_their_error_has_failed() -> None:
    assert len(judged_pockets(against(PLAIN))) == len(PLAIN.pockets)
    assert measure("lin_pocket_depth_bias", against(PLAIN, depth=0.0)).failed


def test_where_the_truth_says_nothing_of_its_furniture_it_is_missing_and_nothing_breaks() -> None:
    case = against(SHORT)
    bare = replace(case, truth=replace(case.truth, furniture={}, cache={}), cache={})
    found = {id: measure(id, bare) for id, row in table.load().items() if row.category in ("LIN", "TRK")}
    assert [id for id, value in found.items() if value.failed] == []
    assert found["trk_sleeper_count_rel_err"].value is found["lin_pocket_f1"].value is None
    assert [one.error for one in worst_windows(bare) if one.error] == []


def test_a_floor_with_steps_everywhere_has_another_95th_percentile() -> None:
    assert raw("nav_step_p95_err", short()) == 0.0
    blocks = [trimesh.creation.box((0.15, 6.0, 0.12)) for _ in range(12)]
    for k, block in enumerate(blocks):
        block.apply_translation(SHORT.point(0.7 + 0.9 * k, 0.0, float(SHORT.floor(0.7 + 0.9 * k)) + 0.1)[0])
    rough = tube.corrupted(short(track=False), extra=trimesh.util.concatenate(blocks))
    assert raw("nav_step_p95_err", rough) > 0.02


def test_nails_are_counted_by_pairs_of_pockets_on_either_side_of_a_joint() -> None:
    case = short()
    value = measure("lin_nail_count_ratio", case)
    joints = np.sum((SHORT.joints > 0.4) & (SHORT.joints < SHORT.length - 0.4))
    assert value.n == 6 * joints
    assert value.value == 0.0
    nailed = tube.corrupted(case, manifest={**case.candidate.manifest, "count": {"nails": 3 * int(joints)}})
    assert raw("lin_nail_count_ratio", nailed) == pytest.approx(0.5)


def test_a_rail_that_rises_2_mm_a_metre_over_the_other_is_that_much_twist() -> None:
    case = tube.case(replace(SHORT, bend=np.inf, grade=0.0, variation=0.0))
    track = case.candidate.track
    assert raw("trk_twist_p95", case) < 0.05
    left = track.rail["left"].copy()
    left[:, 2] += 0.002 * np.linalg.norm(left - left[0], axis=1)
    twisted = tube.corrupted(case, track=replace(track, rail={**track.rail, "left": left}))
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
