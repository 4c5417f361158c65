"""Centrelines and random lines of generated tunnels, names of tunnels, and the control."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax.procedural.geometry import Alignment, draw_alignment, wander
from subterra_jax.procedural.open_world import LINE, SPLITS
from subterra_jax.tunnel import sources
from subterra_jax.tunnel.sources import resolve
from tests.recorded import check

TABLE = Path(__file__).with_name("values.csv")


@pytest.fixture(scope="module")
def lines() -> list[Alignment]:
    return [draw_alignment(np.random.default_rng(seed), 900.0, LINE) for seed in range(12)]


def curvature(station: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return np.diff(heading) / np.diff(station)


def test_curvature_is_bounded_and_changes_along_clothoids(lines):
    bends = [curvature(line.station, line.tangent(line.station)) for line in lines]
    tightest = 1.0 / LINE.radius[0]
    assert max(np.abs(bend).max() for bend in bends) <= tightest + 1e-9
    steepest = max(np.abs(np.diff(bend)).max() for bend in bends) / LINE.grid_step
    assert steepest <= 2.0 * tightest / LINE.transition[0] + 1e-6
    assert max(np.abs(bend).max() for bend in bends) > 0.5 * tightest


def test_positions_are_the_integral_of_the_tangents_and_stations_are_arc_lengths():
    """On one arc the answer is known."""
    radius = 75.0
    arc = Alignment(np.array([0.0, 100.0]), np.full(2, 1 / radius), 100.0, 0.25)
    station = np.linspace(0.0, 100.0, 777)
    truth = radius * np.column_stack([np.sin(station / radius), 1 - np.cos(station / radius)])
    np.testing.assert_allclose(arc.position(station), truth, atol=1e-9)
    turned = arc.offset(station, np.full(777, 5.0))
    np.testing.assert_allclose(np.hypot(turned[:, 0], turned[:, 1] - radius), radius - 5.0, atol=1e-9)


def test_a_clothoid_turns_by_half_its_last_curvature_times_its_length():
    clothoid = Alignment(np.array([0.0, 30.0]), np.array([0.0, 0.02]), 30.0, 0.25)
    assert clothoid.heading(np.array([30.0]))[0] == pytest.approx(0.3, abs=1e-12)
    assert clothoid.heading(np.array([15.0]))[0] == pytest.approx(0.075, abs=1e-12)


def test_no_centreline_comes_near_itself(lines):
    for line in lines:
        station = line.station[::8]
        x, y = line.position(station).T
        gap = np.hypot(x[:, None] - x, y[:, None] - y)
        assert gap[np.abs(station[:, None] - station) > 62.0].min() > 38.0


def test_bends_that_cannot_stay_clear_are_refused():
    coil = dataclasses.replace(LINE, radius=(30.0, 30.0), straight=(15.0, 70.0), arc=(300.0, 300.0), turn=7.0)
    with pytest.raises(st.SubterraError, match="stays 40 m clear of itself"):
        draw_alignment(np.random.default_rng(0), 450.0, coil)


def test_a_random_course_has_its_standard_deviation_and_correlation_length():
    course = wander(np.random.default_rng(0), np.arange(0.0, 20_000.0, 0.5), 0.02, 2.0)
    assert course.std() == pytest.approx(0.02, rel=0.03)
    lag = np.mean(course[4:] * course[:-4]) / course.var()
    assert lag == pytest.approx(np.exp(-1.0), abs=0.04)


def test_the_control_tunnel_has_one_curvature_one_width_and_no_landmark():
    plan = st.load_tunnel("control")
    assert plan.length == pytest.approx(351.0)
    assert list(plan.linings) == ["smooth"]
    assert plan.ring_pitch == 0.0
    np.testing.assert_allclose(curvature(plan.station, plan.tangent), 1 / 300, atol=1e-9)
    station = np.linspace(40.0, 310.0, 50)
    at = lambda values: np.column_stack([np.interp(station, plan.station, column) for column in values.T])  # noqa: E731
    heading = np.arctan2(at(plan.tangent)[:, 1], at(plan.tangent)[:, 0]) + 0.2
    seen = reference.scan(plan.lining("smooth").segments, at(plan.centre), heading)
    # A beam along a wall turns the half millimetre by which chords miss the arc into a few centimetres of range.
    np.testing.assert_allclose(seen, np.broadcast_to(seen.mean(axis=0), seen.shape), atol=0.02)


def test_a_range_of_names_and_a_list_of_them_are_one_stack_cut_to_the_stretch_of_a_task():
    ranged = resolve("open:val:2-4", "smooth", (0.0, 60.0), 30.0)
    listed = resolve([f"open:val:{i}" for i in (2, 3, 4)], "smooth", (0.0, 60.0), 30.0)
    assert ranged.count == resolve([st.load_tunnel("control"), "control", "metro"], None, None, 30.0).count == 3
    np.testing.assert_array_equal(ranged.box, listed.box)
    np.testing.assert_allclose(ranged.length, 60.0)
    with pytest.raises(st.TunnelError, match="1 comes before 3"):
        resolve("open:val:3-1", None, None, 30.0)


def test_where_no_tunnel_is_named_it_is_the_open_worlds_and_the_papers_for_the_papers_task():
    assert st.tasks.tunnel_for("Subterra/StopAt-v1") == "open:train:0-11"
    assert st.tasks.tunnel_for("Subterra/StopAt-v1", split="test-unseen") == "open:test-unseen:0-11"
    assert st.tasks.tunnel_for("Subterra/Traverse-v1") == "subterra-351"
    assert st.tasks.tunnel_for("Subterra/Traverse-v1", split="val") == "open:val:0-11"
    assert st.tasks.tunnel_for("Subterra/StopAt-v1", "control") == "control"
    short = {split: st.tasks.tunnel_for("Subterra/StopAt-v1", split=split, spatial=True) for split in (None, *SPLITS)}
    check(TABLE, "short tunnels", {str(split): names for split, names in short.items()})
    assert st.tasks.first_tunnel("Subterra/StopAt-v1", spatial=True) == short[None][0]
    with pytest.raises(ValueError, match="no split 'test'; there are train, val, test-seen, test-unseen"):
        st.make("Subterra/StopAt-v1", split="test")
    with pytest.raises(ValueError, match="either a tunnel or a split, got both 'control' and 'val'"):
        st.make("Subterra/StopAt-v1", "control", split="val")
    for choice in ({"split": "val"}, {"tunnel": ["subterra-351", "metro"]}):
        with pytest.raises(ValueError, match="B2Walk-v1 happens in one tunnel"):
            st.make("Subterra/B2Walk-v1", **choice)


def afresh(name="open:cast:val:5", length=60.0) -> st.Tunnel:
    """A tunnel as another process has it."""
    sources._named.cache_clear()
    return resolve(name, None, (0.0, length), 30.0)


def test_a_tunnel_is_made_once_and_then_read(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = []
    monkeypatch.setattr(sources, "generate", lambda *args, real=sources.generate: made.append(args) or real(*args))
    first, again = afresh(), afresh()
    assert len(made) == 1
    assert jax.tree.structure(first) == jax.tree.structure(again)
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
        assert isinstance(other, jax.Array)
    afresh(length=61.0)  # another stretch is another tunnel
    monkeypatch.setattr(sources, "_code", lambda: "other code")
    afresh()
    assert len(made) == 3


def test_what_a_process_has_made_it_has_again_even_if_the_first_was_given_away(monkeypatch):
    first = afresh()
    length = float(first.length)
    monkeypatch.setattr(sources, "_kept", None)
    jax.tree.map(lambda leaf: leaf.delete(), first)
    assert float(resolve("open:cast:val:5", None, (0.0, 60.0), 30.0).length) == length


def test_the_cache_does_without_a_folder_survives_damage_and_does_not_grow_for_ever(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    (tmp_path / "file").write_text("in the way")
    assert afresh().count == 1
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    afresh()
    (file,) = (tmp_path / "subterra" / "tunnels").glob("*.pickle")
    file.write_bytes(file.read_bytes()[:100])
    assert afresh().count == 1
    monkeypatch.setattr(sources, "_MOST", file.stat().st_size + 10)
    afresh("open:cast:val:6")
    assert len(list(file.parent.glob("*.pickle"))) == 1
    assert not file.exists()  # the one that was not used for longer
