"""LiDARs in three dimensions as parts of an environment: where they stand, what they see, and how wrong they are."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.host.errors import SubterraError
from subterra_jax.lidar3d import beams, echo
from subterra_jax.lidar3d.space import Mount, into_tunnel, stand
from subterra_jax.parts import make_sensor
from subterra_jax.parts.brightness import intensity
from subterra_jax.parts.spatial_lidar import SENSORS, Sweeping, along_arc
from tests.recorded import check
from tests.subterra_jax import tunnels
from tests.subterra_jax.placing import observe, placed

TABLE = Path(__file__).with_name("values.csv")
TASK, GRADE, HALF = "Subterra/TraverseShort-v1", 0.05, 2.8
EXACT = {"sigma": 0.0, "sigma_per_metre": 0.0, "sigma_slant": 0.0, "losing": False}


def exact(sensor, **changes):
    """The sensor without errors."""
    made = make_sensor(sensor)
    return dataclasses.replace(made, echo=dataclasses.replace(made.echo, **EXACT), **changes)


def straight(grade=0.0):
    station = np.linspace(0.0, 40.0, 81)
    xy = np.stack([station, np.zeros(81)], axis=-1)
    return st.tunnel.from_centreline(xy, HALF, elevation=grade * station, lidar_height=0.7)


@pytest.fixture(scope="module")
def graded():
    return straight(GRADE)


@pytest.mark.slow
def test_level_beams_see_what_the_planar_lidar_sees_on_a_grade(graded):
    fan = exact(beams.planar(16))
    env, params = st.make(TASK, tunnel=graded, sensor=fan)
    flat, flat_params = st.make(TASK, tunnel=graded)
    state = placed(env, params, 15.0, 0.6, 0.3)
    seen = observe(env, state, params)["scan"]
    plane = placed(flat, flat_params, 15.0, 0.6, 0.3)
    drawn = flat.draw_step(jax.random.key(0), (), flat_params)
    noise = {"lidar": dataclasses.replace(drawn["lidar"], normal=jnp.zeros(16))}
    planar = np.asarray(flat.observe(plane, noise, flat_params))[:16]
    # A beam along the grade is longer than its plan.
    assert np.ptp(planar) > 5.0
    np.testing.assert_allclose(seen, planar, rtol=0.5 * GRADE**2, atol=2e-3)


def test_a_pitched_beam_meets_the_ground_where_its_height_says(graded):
    tunnel = st.make(TASK, tunnel=graded, sensor=exact(np.array([[1.0, 0.0, 0.0]])))[1].tunnel
    ahead, down = np.array([[1.0, 0.0, 0.0]]), 0.2
    for heading in (0.0, np.pi, 1.0):
        mount = Mount(height=0.9, pitch=down)
        place, axes = stand(tunnel, jnp.array([10.0, 0.5]), jnp.float32(heading), jnp.float32(10.0), mount)
        ray = np.asarray(into_tunnel(axes, jnp.asarray(ahead)))[0]
        up = np.array([-GRADE, 0.0, 1.0]) / np.hypot(1.0, GRADE)
        foot = np.array([10.0, 0.5, 10.0 * GRADE])
        np.testing.assert_allclose((np.asarray(place) - foot) @ up, 0.9, atol=1e-5)
        np.testing.assert_allclose(ray @ up, -np.sin(down), atol=1e-5)
        assert np.arctan2(ray[1], ray[0]) == pytest.approx(heading, abs=0.02) or heading == np.pi


def test_a_mount_turns_as_its_words_say(graded):
    tunnel = st.make(TASK, tunnel=straight(), sensor=exact(np.array([[1.0, 0.0, 0.0]])))[1].tunnel
    here = jnp.array([10.0, 0.0]), jnp.float32(0.0), jnp.float32(10.0)
    place, axes = stand(tunnel, *here, Mount(height=0.5, lateral=0.2, yaw=0.3))
    np.testing.assert_allclose(place, [10.0, 0.2, 0.5], atol=1e-6)
    np.testing.assert_allclose(axes[0], [np.cos(0.3), np.sin(0.3), 0.0], atol=1e-6)
    _, axes = stand(tunnel, *here, Mount(roll=0.3))
    np.testing.assert_allclose(axes[1], [0.0, np.cos(0.3), np.sin(0.3)], atol=1e-6)  # the left side rises
    np.testing.assert_allclose(np.asarray(axes) @ np.asarray(axes).T, np.eye(3), atol=1e-6)
    _, axes = stand(tunnel, *here, Mount(pitch=0.3))
    np.testing.assert_allclose(axes[0], [np.cos(0.3), 0.0, -np.sin(0.3)], atol=1e-6)  # it looks down


@pytest.mark.slow
def test_a_batch_in_several_tunnels_sees_what_each_robot_sees_alone(graded):
    plans = [graded, straight()]
    env, params = st.make(TASK, tunnel=plans, sensor=exact("spin16x64"))
    batch = st.AutoReset(env)
    obs, state = batch.reset(jax.random.key(3), params, 6)
    assert set(np.asarray(state.tunnel)) == {0, 1}
    obs, state, *_ = batch.step(jax.random.key(4), state, jnp.full((6, 2), 0.8), params)
    for i in range(6):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], state)
        alone, own = st.make(TASK, tunnel=plans[int(one.tunnel)], sensor=exact("spin16x64"))
        one = dataclasses.replace(one, tunnel=jnp.int32(0))
        np.testing.assert_allclose(obs[i, :1024], observe(alone, one, own)["scan"], atol=1e-4)
    assert env.images(params) == {"scan": (16, 64)}


def test_a_way_in_a_sweep_is_the_arc_that_the_robot_drives():
    from subterra_jax.parts.unicycle import follow_arc

    fresh = Sweeping(jnp.array([1.0, 2.0]), jnp.float32(3.0))
    for command in ([1.5, 0.35], [2.0, 0.0], [0.0, 1.0], [1.0, 1e-6]):
        motion = jnp.array(command)
        position, heading = follow_arc(fresh.position, fresh.heading, motion, jnp.float32(0.1))
        fraction = jnp.linspace(0.0, 1.0, 5)
        places, headings = along_arc(fresh, position, heading, fraction)
        for k in range(5):
            place, turned = follow_arc(fresh.position, fresh.heading, motion, 0.1 * fraction[k])
            np.testing.assert_allclose(places[k], place, atol=2e-6)
            np.testing.assert_allclose(np.cos(headings[k] - turned), 1.0, atol=1e-6)


def walls_missed(points):
    """Distance of points from walls, floor and crown of the straight tunnel, m."""
    return np.minimum(abs(abs(points[:, 1]) - HALF), np.minimum(abs(points[:, 2]), abs(points[:, 2] - 6.0)))


def test_a_sweep_of_the_vlp16_falls_on_the_walls_only_when_deskewed_with_the_true_motion():
    env, params = st.make(TASK, tunnel=straight(), sensor=exact("vlp16"), sweep=True)
    state = placed(env, params, 12.0, 0.4, 0.1)
    speed, rate = 1.5, np.deg2rad(20.0)
    noise = env.draw_step(jax.random.key(0), (), params)
    state, *_ = jax.jit(env.advance)(state, jnp.array([speed, rate]), noise, params)
    ranges = observe(env, state, params)["scan"].astype(np.float64)
    times, rays = (np.asarray(leaf, np.float64) for leaf in (params.lidar.times, params.lidar.directions))
    assert times.min() == pytest.approx(-0.1)
    assert -1e-4 < times.max() < 0.0
    there = ranges < 30.0

    def points(since):
        """Points placed by an exact arc over so many seconds, in float64."""
        half = 0.5 * rate * since
        chord = speed * since * np.sinc(half / np.pi)
        heading = 0.1 + rate * since
        origin = np.stack([12.0 + chord * np.cos(0.1 + half), 0.4 + chord * np.sin(0.1 + half)], axis=-1)
        cos, sin = np.cos(heading), np.sin(heading)
        turned = np.stack([cos * rays[:, 0] - sin * rays[:, 1], sin * rays[:, 0] + cos * rays[:, 1]], axis=-1)
        at = origin + ranges[:, None] * turned
        return np.column_stack([at, 0.7 + ranges * rays[:, 2]])[there]

    assert there.mean() > 0.9
    assert walls_missed(points(0.1 + times)).max() < 5e-3
    assert np.quantile(walls_missed(points(np.full(len(times), 0.1))), 0.9) > 0.02


def test_noise_grows_with_range_and_incidence_as_it_says():
    params, n = echo.EchoParams(sigma_slant=0.02), 40_000
    normal = jax.random.normal(jax.random.key(0), (n,))
    for metres, cosine, tangent in ((2.0, 1.0, 0.0), (60.0, np.cos(1.2), np.tan(1.2)), (5.0, 1e-4, 10.0)):
        seen = echo.add_noise(jnp.full(n, metres), jnp.full(n, cosine), normal, params)
        expected = np.sqrt(0.019**2 + (1e-4 * metres) ** 2 + (0.02 * tangent) ** 2)
        assert np.std(np.asarray(seen) - metres) == pytest.approx(expected, rel=0.02)


def test_weak_echoes_are_lost_by_range_incidence_and_material():
    n, uniform = 40_000, jax.random.uniform(jax.random.key(0), (40_000,))
    params = echo.EchoParams(weakest=0.1 / 45.0**2)

    def fraction(metres, cosine, reflectivity):
        ask = [jnp.full(n, value) for value in (metres, cosine, reflectivity)]
        return float(jnp.mean(echo.returns(*ask, uniform, params)))

    assert fraction(45.0, 1.0, 0.1) == pytest.approx(0.5 * 0.996, abs=0.01)
    assert fraction(5.0, 1.0, 0.3) == pytest.approx(0.996, abs=0.002)
    # One standard deviation of the fading: the echo is e^-0.5 of the weakest.
    assert fraction(45.0, np.exp(-0.5), 0.1) == pytest.approx(0.1587, abs=0.01)
    assert fraction(45.0, 1.0, 0.2) > fraction(45.0, 1.0, 0.1) > fraction(60.0, 1.0, 0.1)


def test_materials_are_told_apart_and_bright_when_met_squarely():
    normal_z, thing, below = (
        jnp.array([1.0, 1.0, 0.0, 1.0]),
        jnp.array([0, 0, 0, 1], bool),
        jnp.array([1, 0, 1, 1], bool),
    )
    material = echo.albedo(normal_z, thing, below)
    np.testing.assert_allclose(material, [0.20, 0.30, 0.30, 0.36])
    seen = intensity(jnp.array([1.0, 0.5]), jnp.full(2, 0.3), jnp.zeros(2))
    np.testing.assert_array_equal(seen, [45.0, 22.0])  # whole numbers


def test_pixels_are_mixed_at_edges_alone():
    n = 10_000
    uniform = jax.random.uniform(jax.random.key(0), (n, 2))
    params = echo.EchoParams(mixed=0.25)
    near, ones = jnp.full(n, 5.0), jnp.ones(n)
    mix = jax.jit(echo.mix)
    mixed = np.asarray(mix(near, near + 0.5, 0.4 * ones, uniform, params))
    assert np.mean(mixed != 5.0) == pytest.approx(0.25, abs=0.02)
    assert ((mixed >= 5.0) & (mixed <= 5.5)).all()
    assert np.mean(mixed[mixed != 5.0]) == pytest.approx(5.25, abs=0.02)
    for other, off in ((5.5, 0.02), (6.0, 0.9)):  # one plane met at a slant; an edge that the receiver tells apart
        assert (np.asarray(mix(near, other * ones, off * ones, uniform, params)) == 5.0).all()
    rays = jnp.asarray(beams.spinning(np.deg2rad(np.linspace(22.5, -22.5, 64)), 16))
    rim = np.asarray(jax.jit(echo.rim_of)(rays, uniform[: len(rays), 0], dataclasses.replace(params, divergence=0.01)))
    np.testing.assert_allclose(np.linalg.norm(rim, axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(rim - rays, axis=1), 0.01, rtol=0.01)


@pytest.mark.parametrize("name", SENSORS[1:])
def test_every_named_sensor_is_what_it_was_with_unit_beams_in_order_of_its_image(name):
    made = make_sensor(name)
    rays, times = np.asarray(made.directions, float).reshape(*made.shape, 3), np.reshape(made.times, made.shape)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-5)
    assert times.min() == pytest.approx(-0.1)
    assert times.max() <= 0.0
    azimuth, elevation = np.arctan2(rays[..., 1], rays[..., 0]), np.arcsin(rays[..., 2])
    check(TABLE, f"sensor {name}", {**vars(made), "azimuth": azimuth, "elevation": elevation})
    if made.shape[0] > 1:
        np.testing.assert_allclose(np.ptp(elevation, axis=1), 0.0, atol=1e-5)
        assert (np.diff(times, axis=1) > 0.0).all()


def test_what_is_nearer_than_the_least_range_is_no_return(graded):
    """Beams to the left wall, 2.8 m away, and ahead and up, further away; the least range lies between."""
    beam = np.array([[0.0, 1.0, 0.0], [0.0, np.cos(1.2), np.sin(1.2)]])
    env, params = st.make(TASK, tunnel=graded, sensor=exact(beam, range_min=2.9))
    env, params = st.make(TASK, tunnel=params.tunnel, sensor=params.lidar)  # a ready tunnel with its heights will do
    left, above = observe(env, placed(env, params, 15.0, 0.0, 0.0), params)["scan"]
    assert left == 30.0
    assert 2.9 < above < 30.0


def test_the_vlp16_fires_its_lasers_in_the_order_of_the_manual():
    """Lowest, the one 16 degrees above it, the second lowest: 2.304 µs apart."""
    times = np.asarray(make_sensor("vlp16").times, np.float64).reshape(16, 1800)
    after = (times[:, 0] - times[0, 0]) / 2.304e-6
    np.testing.assert_allclose(after, [*range(0, 16, 2), *range(1, 16, 2)], atol=0.02)


def test_what_no_sensor_can_honour_is_one_sentence(graded, tmp_path):
    ahead = np.array([[1.0, 0.0, 0.0]])
    for wrong, says in (
        ("hdl64", "no sensor 'hdl64'; there are planar16, spin16x64, vlp16, os1-64, avia"),
        (np.zeros((0, 3)), r"one or more beams as unit vectors \(n, 3\), got shape \(0, 3\)"),
        (ahead * np.nan, "beam 0 of the pattern is no number"),
        (2.0 * ahead, "beam 0 of the pattern is no unit vector: its length is 2"),
    ):
        with pytest.raises(ValueError, match=says):
            st.make(TASK, tunnel=graded, sensor=wrong)
    with pytest.raises(ValueError, match="'planar16' measures a scan at one instant"):
        st.make(TASK, tunnel=graded, sweep=True)
    with pytest.raises(ValueError, match="sweep=True does not go with the part 'faults'"):
        st.make("Subterra/Faulted-v1", tunnel=graded, sensor=ahead, sweep=True)
    for mount in (Mount(height=-0.5), Mount(height=7.0), Mount(lateral=3.5)):
        with pytest.raises(SubterraError, match="is inside the wall, or in a thing"):
            st.make(TASK, tunnel=graded, sensor=exact(ahead, mount=mount))
    with pytest.raises(ValueError, match="must be finite"):
        st.make(TASK, tunnel=graded, sensor=exact(ahead, mount=Mount(pitch=np.nan)))
    with pytest.raises(ValueError, match="made for planar LiDARs alone"):
        st.make(TASK, tunnel=st.Tunnel.from_plan(graded), sensor=ahead)
    with pytest.raises(ValueError, match="'sort'"):
        make_sensor("vlp16", sort=1)
    old = tunnels.write_tunnel(tmp_path / "old.npz", tunnels.tunnel_arrays([(30.0, 0.0)]))
    with pytest.raises(st.TunnelError, match=r"old\.npz: holds no heights, .*build the scene again with"):
        st.make(TASK, tunnel=old, sensor="vlp16")
