"""An episode as a page: its geometry against geometry that is known, and what the page plays."""

import base64
import re
from types import SimpleNamespace

import msgspec.msgpack
import numpy as np
import pytest
import zstandard

import subterra_jax as st
from subterra_jax.b2.constants import HIP_X, STAND_HEIGHT
from subterra_jax.b2.kinematics import standing_pose
from subterra_jax.baselines.particle import particle_filter
from subterra_jax.baselines.registry import make_agent
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.recorder.trace import drive, reckon
from subterra_jax.viewer.__main__ import main
from subterra_jax.viewer.chart import error_chart
from subterra_jax.viewer.episode import Drawn, draw
from subterra_jax.viewer.page import _Legs, write_page
from subterra_jax.viewer.shapes import Centreline, planar_shapes
from tests.recorded import check
from tests.subterra_jax import tunnels


@pytest.fixture(scope="module")
def centreline(plan_of):
    return Centreline(plan_of(tunnels.tunnel_arrays(tunnels.straight(60.0))))


def straight(centreline, n=21, **changes):
    """A drive along x at 2 m/s; the odometer reads 10 % too much and the estimate is 1 m ahead."""
    x, zero = 0.2 * np.arange(n), np.zeros(n)
    state = SimpleNamespace(station=x)
    cloud, pose = np.zeros((n, 0, 3)), np.zeros((n, 0, 19))
    trace = SimpleNamespace(state=state, cloud=cloud, pose=pose, period=0.1, ended="success", time=0.1 * x)
    fields = {
        "centreline": centreline,
        "trace": trace,
        "goal": 40.0,
        "truth": np.stack([x, zero, zero], -1),
        "heading": zero,
        "reckoned": np.stack([1.1 * x, zero, zero], -1),
        "reckoned_heading": zero,
        "odometer_error": 0.1 * x,
        "estimate": np.stack([np.where(x > 0, x + 1.0, np.nan), zero + 0.5], -1),
        "hits": np.tile(np.array([[0.0, 2.0, 0.6], [np.nan] * 3]), (n, 1, 1)),
        "boxes": np.zeros((0, 6)),
    }
    return Drawn(**{**fields, **changes})


def test_the_robot_is_half_way_between_two_rows_at_half_a_row(centreline):
    drawn = straight(centreline)
    np.testing.assert_allclose(drawn.pose(2.5)[0], [0.5, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(drawn.pose(2.5, reckoned=True)[0], [0.55, 0.0, 0.0], atol=1e-6)


def test_odometry_that_turns_too_much_drives_a_circle():
    turn = np.linspace(0.0, np.pi, 2001)
    way, _ = reckon(np.stack([5.0 * turn, turn], axis=-1), np.array([1.0, 2.0]))
    np.testing.assert_allclose(way[-1], [1.0, 12.0], atol=1e-4)
    np.testing.assert_allclose(np.hypot(*(way - [1.0, 7.0]).T), 5.0, atol=1e-4)


def test_the_ellipse_reaches_two_standard_deviations_and_is_as_wide_as_the_particles(centreline):
    drawn = straight(centreline)
    points = drawn.ellipse(10).reshape(-1, 3)
    np.testing.assert_allclose([points[:, 0].min(), points[:, 0].max()], [2.0, 4.0], atol=0.01)
    assert drawn.ellipse(0).shape == (0, 2, 3)
    drawn.trace.cloud = np.tile(np.array([[0.0, 0.5, 1.0], [0.0, 1.5, 1.0]]), (21, 1, 1))
    points = drawn.ellipse(10).reshape(-1, 3)
    np.testing.assert_allclose([points[:, 1].min(), points[:, 1].max()], [0.0, 2.0], atol=0.01)
    np.testing.assert_allclose(drawn.particles(3)[:, :2], [[0.0, 0.5], [0.0, 1.5]])


def test_the_gate_stands_at_the_goal_and_is_as_wide_as_the_tunnel(centreline):
    gate = straight(centreline).gate().reshape(-1, 3)
    np.testing.assert_allclose(gate[:, 0], 40.0, atol=1e-6)
    np.testing.assert_allclose(np.ptp(gate[:, 1]), 2 * 2.825 - 0.1, atol=1e-6)
    assert len(straight(centreline, goal=np.nan).gate()) == 0


def test_walls_stand_where_the_lining_has_them_and_are_seen_from_within(centreline):
    for shape in planar_shapes(centreline.plan, "smooth"):
        corners = shape.vertices[shape.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        inside = np.array([30.0, 0.0, 1.3]) - corners.mean(axis=1)
        inside[:, 0] = 0.0
        assert (np.sum(normal * inside, axis=1) > 0.0).all(), shape.name
    left, right, floor = planar_shapes(centreline.plan, "pockets")
    check(__file__, "shapes", {one.name: [one.vertices, one.faces] for one in (left, right, floor)})
    np.testing.assert_allclose(left.vertices[:, 1].min(), 2.825, atol=1e-6)
    np.testing.assert_allclose(left.vertices[:, 1].max(), 2.825 + tunnels.POCKET_DEPTH, atol=1e-6)
    assert right.vertices[:, 1].max() < 0.0 < left.vertices[:, 2].max()
    assert not floor.vertices[:, 2].any()


def test_rails_and_sleepers_of_a_stretch_are_drawn(centreline):
    *_, rail, sleeper = planar_shapes(st.load_tunnel("subterra-351").slice(100.0, 60.0), "pockets")
    check(__file__, "track", {one.name: [one.vertices, one.faces] for one in (rail, sleeper)})
    assert (rail.name, sleeper.name, len(sleeper.faces) // 12) == ("rail", "sleeper", 100)


def test_furniture_stands_on_the_ground_where_it_is(plan_of):
    arrays = tunnels.tunnel_arrays(tunnels.straight(60.0))
    arrays["elevation"] = 0.1 * arrays["station"]
    arrays["furniture_smooth"] = np.array([[30.0, 2.0, 30.0, 2.4], [45.0, -2.0, 45.2, -2.0]])
    *_, panels = planar_shapes(plan_of(arrays), "smooth")
    np.testing.assert_allclose(
        panels.vertices[:4], [[30, 2, 3], [30, 2.4, 3], [45, -2, 4.5], [45.2, -2, 4.5]], atol=1e-6
    )
    assert len(panels.faces) == 8
    assert all(len({corner // 2 % 2 for corner in face}) == 1 for face in panels.faces), "two panels are joined"


def test_an_episode_is_the_one_that_the_evaluation_drives_and_is_drawn_where_it_was(plan_of):
    plan = plan_of(tunnels.tunnel_arrays(tunnels.straight(30.0)))
    env, params = st.make("Subterra/Traverse-v1", tunnel=plan, lining="smooth")
    agent, one = particle_filter(params, 600), np.zeros(1, np.int32)
    record = evaluate(env, params, agent, Episodes(np.array([5], np.uint32), one, one, one))
    trace = drive(env, params, agent, 5)
    assert (trace.success, trace.contact) == (record.success[0], record.contact[0])
    np.testing.assert_allclose(trace.time[-1], record.time[0], atol=1e-3)
    np.testing.assert_allclose(trace.coverage[-1], record.coverage[0], atol=1e-5)
    drawn = draw(env, params, plan, trace)
    travelled = np.linalg.norm(np.diff(drawn.truth, axis=0), axis=1).sum()
    np.testing.assert_allclose(travelled, record.travelled[0], rtol=1e-4)
    np.testing.assert_allclose(drawn.estimate[-1, 0] - drawn.truth[-1, 0], record.axial_final[0], atol=1e-3)
    assert np.isnan(drawn.estimate[0, 0])
    rows = {name: np.asarray(one)[:20] for name, one in vars(drawn).items() if isinstance(one, np.ndarray)}
    check(
        __file__, "drawn", {**rows, "ellipse": drawn.ellipse(10), "gate": drawn.gate(), "cloud": trace.cloud[:2]}, 1e-3
    )
    cos, sin = np.cos(drawn.heading[:, None]), np.sin(drawn.heading[:, None])
    across = drawn.truth[:, None, 1] + sin * drawn.hits[..., 0] + cos * drawn.hits[..., 1]
    seen = np.isfinite(across)
    assert np.abs(np.abs(across[seen]) - 2.825).max() < 0.3  # walls, up to the noise of ranges
    assert seen.mean() > 0.5


def played(path):
    """Return a page's text and the messages that it plays: time, s, and content."""
    page = path.read_text()
    packed = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)[1])
    raw = zstandard.decompress(packed[8:])
    return page, msgspec.msgpack.decode(raw[8 : 8 + int.from_bytes(raw[:8], "little")])


def gathered(messages):
    """Numbers of a page's messages by kind and node, in the order in which they are played."""
    found = {}
    for time, one in messages:
        rows = found.setdefault(f"{one['type']} {one.get('name', '')}", {"time": []})
        rows["time"].append(time)
        for field, value in {**one, **(one.get("props") or {})}.items():
            if isinstance(value, bytes):
                value = len(value)
            if np.asarray(value).dtype.kind in "if":
                rows.setdefault(field, []).append(float(np.sum(np.cos(np.arange(np.size(value))) * np.ravel(value))))
    return found


def test_the_tunnel_moves_past_the_robot_and_the_page_names_what_it_shows(centreline, tmp_path):
    drawn = straight(centreline, heading=np.full(21, np.pi / 2))
    write_page(tmp_path / "a.html", drawn, planar_shapes(centreline.plan, "smooth"), 0.35, {"task": "<StopAt>"})
    page, content = played(tmp_path / "a.html")
    assert all(word in page for word in ("task: &lt;StopAt&gt;", "success", "estimate ± 2 sd", "goal", "time, s"))
    assert content["durationSeconds"] == pytest.approx(2.0, abs=0.1)
    placed = [(time, one["position"]) for time, one in content["messages"]
              if (one["type"], one.get("name")) == ("SetPositionMessage", "/world")]  # fmt: skip
    # At 2 m/s along x, seen by one who looks to +y: the tunnel moves to the left.
    time, place = next(each for each in placed if each[0] > 0.95)
    np.testing.assert_allclose(place, [0.0, 2.0 * time, 0.0], atol=0.08)
    names = {one.get("name") for _, one in content["messages"]}
    check(__file__, "page", {"sent": gathered(content["messages"])})
    assert {"/robot", "/beams", "/hits", "/world/goal", "/world/estimate", "/world/odometry/robot"} <= names
    box = np.array([[12.0, 1.0, 0.8, 0.6, 0.4, 0.3]])
    bare = straight(centreline, goal=np.nan, estimate=np.full((21, 2), np.nan), boxes=box)
    bare.trace.pose = np.tile(np.r_[3.0, 4.0, 1.5, 1.0, 0.0, 0.0, 0.0, standing_pose()[0]], (21, 10, 1))
    bare.trace.pose[..., 0] += np.linspace(0.0, 4.0, 210).reshape(21, 10)
    write_page(tmp_path / "b.html", bare, [], 0.35, {})
    sent = gathered(played(tmp_path / "b.html")[1]["messages"])
    check(__file__, "walker", {"sent": {name: one for name, one in sent.items() if "robot" in name or "box" in name}})
    assert "estimate" not in played(tmp_path / "b.html")[0].rpartition("<div")[2]


def test_the_chart_spans_the_errors(centreline):
    chart = error_chart(straight(centreline))
    assert re.findall(r">(-?[\d.]+)<", chart) == ["2.0", "-0.1", "0", "2"]  # m up, m down, s
    assert chart.count("<polyline") == 3 + 4
    check(__file__, "chart", {"numbers": [float(one) for one in re.findall(r"-?\d+\.?\d*", chart)]})


@pytest.mark.parametrize("turned", [0.0, np.pi / 2])
def test_thirteen_bodies_of_a_b2_stand_and_face_where_it_does(turned):
    made = {}

    def add(name, mesh, **_options):
        made[name.rpartition("/")[2]] = node = SimpleNamespace(mesh=mesh, position=None, wxyz=None)
        return node

    quaternion = [np.cos(turned / 2), 0.0, 0.0, np.sin(turned / 2)]
    legs = _Legs(SimpleNamespace(add_mesh_trimesh=add))
    legs.place(np.concatenate([[3.0, 4.0, 1.0 + STAND_HEIGHT], quaternion, standing_pose()[0]]))
    assert len(made) == 13
    placed = {name: [node.position, node.wxyz, node.mesh.vertices] for name, node in made.items()}
    check(__file__, f"legs {turned > 0.0}", placed)
    assert all(len(node.mesh.faces) for node in made.values())
    np.testing.assert_allclose(made["base_link"].position, [3.0, 4.0, 1.0 + STAND_HEIGHT])
    assert made["FL_hip"].position[int(turned > 0.0)] == pytest.approx((3.0, 4.0)[int(turned > 0.0)] + HIP_X)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["Subterra/TraverseShort-v1", "Subterra/B2Traverse-v1"])
def test_what_a_lidar_in_three_dimensions_sees_is_drawn_about_the_robot(task):
    plan, legs = st.load_tunnel("subterra-351", solid=True), {"engine": "mujoco"} if "B2" in task else {}
    env, params = st.make(task, plan, "smooth", sensor="spin16x64", **legs)
    trace = drive(env, params, make_agent("dead-reckoning", params), 3, steps=3)
    drawn = draw(env, params, plan, trace)
    assert drawn.hits.shape == (4, 1024, 3)
    half = float(np.interp(2.0, plan.station, plan.half_width))
    for row in drawn.hits:
        near = row[(np.abs(row[:, 0]) < 1.0) & (row[:, 2] > 0.4)]
        assert np.ptp(near[:, 1]) == pytest.approx(2.0 * half, abs=0.5)  # both walls, at heights that the rings reach
        floor = row[(np.abs(row[:, 1]) < 0.7) & (np.abs(row[:, 0]) > 2.0) & (row[:, 2] < 0.3)]
        assert np.median(floor[:, 2]) == pytest.approx(0.0, abs=0.12)
    assert trace.pose.shape[1] == (10 if legs else 0)


def test_the_command_writes_a_page(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["--task", "TraverseShort", "--tunnel", "control", "--steps", "5", "--out", "a.html"]) == 0
    assert "5 steps, cut: a.html" in capsys.readouterr().out
    assert played(tmp_path / "a.html")[1]["durationSeconds"] == pytest.approx(0.5, abs=0.1)
