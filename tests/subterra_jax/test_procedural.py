"""The family of tunnels: what it promises about lengths, bends, widths, rings, recesses and seeds."""

import dataclasses

import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import procedural
from subterra_jax.lidar import reference
from subterra_jax.procedural import _streams, geometry
from subterra_jax.procedural.geometry import Alignment, wander
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.sources import resolve
from tests.subterra_jax.test_lidar import check_exact

CONFIG = procedural.ProceduralConfig()
SEEDS = range(40)


@pytest.fixture(scope="module")
def plans() -> list[st.TunnelPlan]:
    return [procedural.plan(seed) for seed in SEEDS]


def curvature(plan: st.TunnelPlan) -> np.ndarray:
    heading = np.unwrap(np.arctan2(plan.tangent[:, 1], plan.tangent[:, 0]))
    return np.diff(heading) / np.diff(plan.station)


def within(values, bounds) -> bool:
    return bool(np.min(values) >= bounds[0] and np.max(values) <= bounds[1])


def test_every_tunnel_is_within_the_ranges_of_its_family(plans):
    draws = [procedural.draw(seed) for seed in SEEDS]
    for field in dataclasses.fields(CONFIG):
        if field.name in {f.name for f in dataclasses.fields(procedural.Draw)}:
            values = [getattr(drawn, field.name) for drawn in draws]
            low, high = getattr(CONFIG, field.name)
            assert within(values, (low, high)), field.name
            assert np.ptp(values) > 0.5 * (high - low), f"{field.name} hardly varies"
    assert within([p.length for p in plans], CONFIG.length)
    assert within([2 * p.half_width.mean() for p in plans], (CONFIG.width[0] - 0.03, CONFIG.width[1] + 0.03))
    assert {d.rows for d in draws} == {("left", "right"), ("left",), ("right",)}


def test_curvature_is_bounded_and_changes_along_clothoids(plans):
    for plan in plans:
        assert np.abs(curvature(plan)).max() <= 1 / 60 + 1e-9
        assert (
            np.abs(np.diff(curvature(plan)) / np.diff(plan.station)[1:]).max() <= 2 / 60 / CONFIG.transition[0] + 1e-6
        )
    assert max(np.abs(curvature(plan)).max() for plan in plans) > 1 / 90


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


def test_no_tunnel_comes_near_itself(plans):
    for plan in plans:
        x, y = plan.centre[::8].T
        gap = np.hypot(x[:, None] - x, y[:, None] - y)
        far = np.abs(plan.station[::8, None] - plan.station[::8]) > 62.0
        assert gap[far].min() > 38.0


def test_recesses_have_their_depth_repeat_with_the_rings_and_are_missing_as_often_as_drawn():
    config = dataclasses.replace(CONFIG, roughness=(0.0, 0.0), width_sd=(0.0, 0.0), one_wall_share=0.0)
    plan, drawn = procedural.plan(5, config), procedural.draw(5, config)
    wall = plan.lining("pockets").left
    foot = geometry.draw_alignment(_streams(5)[1], drawn.length, config)
    normal = foot.tangent(wall.station)[:, ::-1] * [-1.0, 1.0]
    depth = np.sum((wall.vertex - foot.position(wall.station)) * normal, axis=1) - 0.5 * drawn.width
    deep = depth > 1e-6
    np.testing.assert_allclose(depth[deep], drawn.pocket_depth, atol=1e-6)
    starts, ends = wall.station[deep][::2], wall.station[deep][1::2]
    np.testing.assert_allclose(ends - starts, drawn.pocket_length, atol=1e-6)
    phase = np.mod(0.5 * (starts + ends) - drawn.first_joint + 0.5 * drawn.ring_pitch, drawn.ring_pitch)
    np.testing.assert_allclose(np.abs(phase - 0.5 * drawn.ring_pitch), drawn.pocket_offset, atol=1e-6)
    assert plan.ring_pitch == drawn.ring_pitch
    expected = (1 - drawn.pocket_missing) * 2 * drawn.length / drawn.ring_pitch
    assert len(starts) == pytest.approx(expected, abs=4 * expected**0.5)


def test_where_only_one_wall_has_recesses_the_other_is_smooth(plans):
    seed = next(s for s in SEEDS if procedural.draw(s).rows == ("left",))
    smooth, pockets = plans[seed].lining("smooth"), plans[seed].lining("pockets")
    np.testing.assert_array_equal(pockets.right.vertex, smooth.right.vertex)
    assert len(pockets.left.vertex) > len(smooth.left.vertex) + 500


def test_a_random_course_has_its_standard_deviation_and_correlation_length():
    course = wander(np.random.default_rng(0), np.arange(0.0, 20_000.0, 0.5), 0.02, 2.0)
    assert course.std() == pytest.approx(0.02, rel=0.03)
    lag = np.mean(course[4:] * course[:-4]) / course.var()
    assert lag == pytest.approx(np.exp(-1.0), abs=0.04)


def test_the_same_seed_gives_the_same_tunnel_and_another_seed_another(plans):
    again = procedural.plan(7)
    for name, lining in plans[7].linings.items():
        np.testing.assert_array_equal(lining.segments, again.lining(name).segments)
    alone = procedural.plan(7, linings=("furnished",)).lining("furnished")
    np.testing.assert_array_equal(alone.segments, again.lining("furnished").segments)
    assert plans[8].length != plans[7].length


def test_the_splits_share_no_seed():
    edges = [procedural.seed_of(split, index) for split in ("train", "val", "test") for index in (0, 999_999)]
    assert edges == sorted(set(edges))
    with pytest.raises(ValueError, match="tunnel 1000000 is not in split 'train'"):
        procedural.seed_of("train", 1_000_000)
    with pytest.raises(ValueError, match=r"no split 'dev'.*train, val, test"):
        procedural.seed_of("dev", 0)


@pytest.mark.parametrize("lining", ["pockets", "furnished"])
def test_scans_in_the_family_are_exact(plans, lining):
    check_exact(plans[3], lining, 3000)


def test_a_family_is_the_stack_of_its_tunnels():
    stack = procedural.family("val", 3, "smooth", first=2)
    own = Tunnel.from_plan(st.load_tunnel("procedural:val:3"), "smooth")
    assert stack.count == 3
    picked = stack.pick(1)
    assert (float(picked.length), float(picked.ring_pitch)) == (float(own.length), float(own.ring_pitch))
    first = int(picked.first_node)
    np.testing.assert_array_equal(stack.grid[first : first + int(own.n_nodes)], own.grid)


def test_the_control_tunnel_has_one_curvature_one_width_and_no_landmark():
    plan = st.load_tunnel("control")
    assert plan.length == pytest.approx(351.0)
    assert list(plan.linings) == ["smooth"]
    assert plan.ring_pitch == 0.0
    np.testing.assert_allclose(curvature(plan), 1 / 300, atol=1e-9)
    station = np.linspace(40.0, 310.0, 50)
    at = lambda values: np.column_stack([np.interp(station, plan.station, column) for column in values.T])  # noqa: E731
    heading = np.arctan2(at(plan.tangent)[:, 1], at(plan.tangent)[:, 0]) + 0.2
    seen = reference.scan(plan.lining("smooth").segments, at(plan.centre), heading)
    # A beam along a wall turns the half millimetre by which chords miss the arc into a few centimetres of range.
    np.testing.assert_allclose(seen, np.broadcast_to(seen.mean(axis=0), seen.shape), atol=0.02)


def test_the_control_tunnel_takes_its_only_lining_by_default_and_refuses_others():
    assert resolve("control", None, None, 30.0).count == 1
    with pytest.raises(st.TunnelError, match="'control' has no lining 'pockets'; it has smooth"):
        resolve("control", "pockets", None, 30.0)


def test_a_range_of_names_and_a_list_of_them_are_the_family_cut_to_the_piece_of_a_task():
    ranged = resolve("procedural:val:2-4", "smooth", (0.0, 60.0), 30.0)
    listed = resolve([f"procedural:val:{i}" for i in (2, 3, 4)], "smooth", (0.0, 60.0), 30.0)
    assert ranged.count == 3
    np.testing.assert_array_equal(ranged.box, listed.box)
    np.testing.assert_allclose(ranged.length, 60.0)
    with pytest.raises(st.TunnelError, match="1 comes before 3"):
        resolve("procedural:val:3-1", None, None, 30.0)


@pytest.mark.parametrize(
    "name", ["procedural:test", "procedural:dev:3", "procedural:test:1000000", "procedural:test:x"]
)
def test_a_name_that_no_generated_tunnel_has_is_refused(name):
    with pytest.raises(st.TunnelError, match=f"no tunnel '{name}'"):
        st.load_tunnel(name)


@pytest.mark.parametrize(
    ("field", "value"),
    [("length", (300.0, 200.0)), ("width", (0.0, 5.0)), ("pocket_missing", (0.0, 1.5)), ("one_wall_share", -0.1)],
)
def test_an_impossible_range_is_refused_by_name(field, value):
    with pytest.raises(ValueError, match=field):
        procedural.plan(0, dataclasses.replace(CONFIG, **{field: value}))


def test_recesses_that_would_overlap_and_bends_that_cannot_stay_clear_are_refused():
    with pytest.raises(ValueError, match="would overlap"):
        procedural.plan(0, dataclasses.replace(CONFIG, pocket_length=(0.15, 0.4)))
    coil = dataclasses.replace(CONFIG, radius=(30.0, 30.0), arc=(300.0, 300.0), turn=7.0, length=(400.0, 500.0))
    with pytest.raises(st.SubterraError, match="stays 40 m clear of itself"):
        procedural.plan(0, coil)
    with pytest.raises(ValueError, match="must not be negative, got -1"):
        procedural.plan(-1)
