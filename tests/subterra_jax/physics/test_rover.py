"""The rover: it drives as reported where the ground lets it, and nothing lets it through."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.episode import Driver
from subterra_jax.host import rover
from subterra_jax.physics.engine import Body, Engine, MujocoEngine, mjx
from subterra_jax.physics.ground import RAIL_HALF, RAIL_OFFSET, join_tracks, read_track
from subterra_jax.physics.riding import Ride, advance_period
from subterra_jax.physics.rolling import ROVER
from subterra_jax.physics.stage import RobotError, tunnel_world
from subterra_jax.physics.warp import INSTALLED, WarpEngine
from subterra_jax.policies.opening import open_agent
from subterra_jax.rules import StartParams
from subterra_jax.tunnel import Tunnel
from tests.recorded import check, named
from tests.subterra_jax.physics.test_ground import sleepers
from tests.subterra_jax.tunnels import straight, tunnel_arrays

ID = "Subterra/TraverseShort-v1"
HALF_WIDTH = 2.0
PERIOD = 0.02  # s
IN_MJX = {"mjx-jax": Engine(ROVER)} | ({"mjx-warp": WarpEngine(ROVER, on_cpu=True)} if INSTALLED else {})
ENGINES = ("mujoco", *IN_MJX)


@pytest.fixture(scope="module")
def plans(plan_of):
    """A level floor between two walls, and the same with sleepers that stand out by 6 cm, and rails."""
    floor = plan_of(tunnel_arrays(straight(40.0), half_width=HALF_WIDTH))
    return floor, dataclasses.replace(floor, shell=SimpleNamespace(track=sleepers(56, protrusion=0.06)))


@pytest.fixture(scope="module")
def drives(plans):
    """Positions of each control period over the tunnel's floor (m), velocities (m/s), mean turn of wheels (rad)."""
    tracks, tunnel = [read_track(plan) for plan in plans], Tunnel.from_plan(plans[0], "smooth")
    both = join_tracks(tracks)
    worlds = [lambda p=plan, t=track: tunnel_world(p, t, "smooth") for plan, track in zip(plans, tracks, strict=True)]
    engines = [MujocoEngine(ROVER, world=world) for world in worlds]
    quick = {"xla_backend_optimization_level": 0}
    compiled = {}

    def advance(name, laid, ride, control):
        if name == "mujoco":
            origin, engine = np.asarray(both.position)[ride.anchor], engines[laid]
            return Ride(engine.bench.run(ride.body, control, origin, None, engine.substeps), ride.anchor)
        if name not in compiled:
            one = lambda ride, control: advance_period(IN_MJX[name], ride, control, None, both, tunnel)[0]  # noqa: E731
            compiled[name] = jax.jit(one).lower(ride, control).compile(quick)
        return compiled[name](ride, control)

    def run(name, laid, seconds, control, place=(10.0, 0.0, 0.0), yaw=0.0, velocity=(0.0, 0.0, 0.0)):
        anchor = both.nearest(jnp.float32(place[0]), laid)
        position = np.asarray(place) - np.asarray(both.position)[anchor]
        position[2] += rover.HEIGHT
        pose = np.array([*position, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2), *np.zeros(4)], np.float32)
        rest = np.zeros(10, np.float32)
        speed = rest.copy()
        speed[:3] = velocity
        ride, rows = Ride(Body(pose, speed, rest, np.zeros(2, np.float32)), anchor), []
        for k in range(round(seconds / PERIOD)):
            outcome = control(k * PERIOD) if callable(control) else control
            ride = advance(name, laid, ride, np.array(outcome, np.float32))
            place = np.asarray(both.position)[ride.anchor] + ride.body.qpos[:3]
            rows.append((place, ride.body.qvel[:3], np.mean(ride.body.qpos[7:])))
        where, velocity, wheels = (np.array(part) for part in zip(*rows, strict=True))
        return where - [0.0, 0.0, rover.HEIGHT], velocity, wheels

    return {name: functools.partial(run, name) for name in ENGINES}


@pytest.fixture(params=ENGINES)
def drive(drives, request):
    return drives[request.param]


def test_on_a_level_floor_it_goes_as_far_as_it_is_told(drive):
    where, velocity, _ = drive(0, 4.0, (1.0, 0.0))
    assert where[-1, 0] - where[99, 0] == pytest.approx(2.0, rel=0.02)
    assert np.abs(where[:, 1]).max() < 0.01
    assert np.abs(where[50:, 2]).max() < 0.01, "its tyres give way by less than a centimetre"
    assert velocity[-1, 0] == pytest.approx(1.0, rel=0.02)


def test_it_turns_on_the_spot(drive):
    where, *_ = drive(0, 3.0, (0.0, 0.8))
    assert np.linalg.norm(where[-1, :2] - where[0, :2]) < 0.05


def test_a_wall_stops_it_within_a_centimetre(drive):
    where, *_ = drive(0, 3.0, (1.0, 0.0), (10.0, 0.8, 0.0), np.pi / 2)
    nose = where[:, 1] + rover.HALF_SIZE[0]
    assert HALF_WIDTH - 0.03 < nose.max() < HALF_WIDTH + 0.01
    assert np.ptp(where[-25:], axis=0).max() < 0.01, "its wheels spin and it stays"


def test_it_cannot_climb_a_rail(drive):
    where, *_ = drive(1, 3.0, (0.6, 0.0), yaw=0.6)
    inner = RAIL_OFFSET - RAIL_HALF[0] - rover.TRACK / 2  # of its middle, where a wheel stood at the rail
    assert 0.1 < where[:, 1].max() < inner + 0.01
    assert where[:, 2].max() < 0.1


def test_it_drives_over_sleepers_and_slips(drive):
    where, _, wheels = drive(1, 4.0, (1.0, 0.0))
    gone, turned = where[-1, 0] - where[50, 0], wheels[-1] - wheels[50]
    assert turned * rover.ROLLED_ON_SLEEPERS == pytest.approx(gone, rel=0.015)
    assert turned * rover.ROLLED > 1.08 * gone, "its wheels go up and down, and slip"
    assert -0.12 < where[:, 2].min() < where[:, 2].max() < 0.1
    for aside in (0.0, 0.1, -0.15):
        fast, *_ = drive(1, 6.0, (1.5, 0.05), (10.0, aside, 0.0))
        assert fast[:, 2].max() < 0.1, "it leaps"


def test_energy_does_not_come_from_nothing(drive):
    """Dropped by 10 cm and pushed aside at 1 m/s, asked to stand: it never has more energy than at first."""
    where, velocity, _ = drive(0, 2.0, (0.0, 0.0), (10.0, 0.0, 0.1), velocity=(0.0, 1.0, 0.0))
    energy = 9.81 * where[:, 2] + 0.5 * np.sum(velocity**2, axis=1)  # J/kg
    assert energy.max() < 9.81 * 0.1 + 0.5 + 1e-3
    assert np.abs(velocity[-1]).max() < 0.02
    assert where[-1, 2] == pytest.approx(0.0, abs=0.01)


def test_from_one_state_all_engines_drive_alike_for_ten_seconds(drives):
    """Away from walls and rails, which turn a robot to one side or the other by a hair's breadth."""
    for laid, most, aside in ((0, 0.25, 0.0), (1, 0.05, 0.1)):
        winding = lambda t, most=most: (0.6, most * np.cos(0.6 * t))  # noqa: E731
        in_c, *in_mjx = (drive(laid, 10.0, winding, (10.0, aside, 0.0))[0] for drive in drives.values())
        assert np.linalg.norm(np.array(in_mjx) - in_c, axis=2).max() < 0.03
        assert np.ptp(in_c[:, 0]) > 5.0


@pytest.mark.skipif(not INSTALLED, reason="needs Warp")
@pytest.mark.parametrize(("contacts", "rows"), [(24, 36), (1, 36), (24, 3)])
def test_warp_tells_that_its_buffers_are_too_small(task, contacts, rows, monkeypatch):
    _, params, go = task
    rides = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), go([(1.0, 0.0)] * 3)[1][-1][0].parts["rover"])
    whole = WarpEngine._in_warp

    def small(engine, n):
        with jax.ensure_compile_time_eval():
            data = mjx.make_data(engine.host, impl="warp", naconmax=contacts, naccdmax=0, njmax=rows)
        return whole(engine, n)[0], data

    monkeypatch.setattr(WarpEngine, "_in_warp", small)
    one = functools.partial(advance_period, WarpEngine(ROVER, on_cpu=True))
    shared = jnp.zeros(2), None, params.track, params.tunnel
    after, *_, wrong = jax.vmap(one, (0, *[None] * 4))(rides, *shared)
    assert bool(wrong.all()) == bool(wrong.any()) == ((contacts, rows) != (24, 36))
    assert np.isfinite(after.body.qpos).all()


def test_warp_sees_nested_batches_as_one_and_jax_serves_where_it_cannot(monkeypatch):
    """With a stand-in for the steps of both, since Warp may not be installed."""
    step, sizes = lambda engine, body, control, window, build=None: body.replace(qvel=control[0] * body.qvel), []
    monkeypatch.setattr(Engine, "run", step)
    monkeypatch.setattr(WarpEngine, "_in_warp", lambda engine, n: (sizes.append(n), None))
    monkeypatch.setattr(WarpEngine, "_advance", lambda engine, model, data, *given: step(engine, *given))
    body, speeds = Body(jnp.ones(11), jnp.arange(10.0), jnp.zeros(10)), jnp.arange(6.0).reshape(2, 3)
    run = lambda v, on_cpu=True: WarpEngine(ROVER, on_cpu=on_cpu).run(body, jnp.stack([v, v]), None).qvel  # noqa: E731
    assert run(2.0, on_cpu=False)[3] == 6.0
    assert not sizes
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.vmap(run)))(speeds), speeds[..., None] * body.qvel)
    assert sizes[-1] == 6
    assert jax.grad(lambda v: run(v)[3])(2.0) == 3.0


@pytest.fixture(scope="module")
def task(plans):
    env, params = st.make(ID, tunnel=plans[0], motion="rover", engine="mujoco")
    reset, step = jax.jit(env.reset), jax.jit(env.step)

    def go(commands, **changes):
        other = params.replace(**changes)
        first, state = reset(jax.random.key(1), other)
        obs, outcome = [first], []
        for k, command in enumerate(commands):
            seen, state, *rest = step(jax.random.key(k), state, jnp.array(command, jnp.float32), other)
            obs.append(seen)
            outcome.append((state, *rest))
        return np.array(obs), outcome

    return env, params, go


def test_its_task_is_that_of_the_kinematic_robot(task, plans):
    env, params, go = task
    wheels, planar = st.make(ID, tunnel=plans[0], vehicle=params.vehicle, start=params.start)
    assert env.fields(params) == wheels.fields(planar)
    assert env.rule == wheels.rule
    open_agent(ID.split("/")[1], env, params.replace(start=StartParams(lateral=0.1)))  # one for wheels may drive it
    obs, outcome = go([(1.0, 0.1)] * 40)
    _, state = jax.jit(wheels.reset)(jax.random.key(1), planar)
    np.testing.assert_allclose(state.position, outcome[0][0].position, atol=0.02)
    far, step = [], jax.jit(wheels.step)
    for k in range(40):
        _, state, *_ = step(jax.random.key(k), state, jnp.array([1.0, 0.1]), planar)
        far.append(float(state.station))
    mine = [float(step[0].station) for step in outcome]
    assert mine[-1] - mine[9] == pytest.approx(far[-1] - far[9], rel=0.02)
    at = env.fields(params)["odometry"].start
    assert obs[-1, at] == pytest.approx(mine[-1] - 1.0, abs=0.2)
    beside, _ = go([(1.0, 0.1)] * 40, track=params.track.replace(protrusion=params.track.protrusion + 0.06))
    assert beside[-1, at] * rover.ROLLED / rover.ROLLED_ON_SLEEPERS == pytest.approx(obs[-1, at], rel=0.02)
    assert not any(bool(step[2]) for step in outcome)
    told = jax.tree.map(lambda *rows: np.stack(rows), *outcome[:10])
    check(__file__, "task", {"seen": obs[:11], **named(told)}, 2e-3)


def test_in_a_stack_it_stands_on_the_ground_of_its_own_tunnel(plans):
    env, params = st.make("Subterra/Traverse-v1", tunnel=[plans[1], *plans], motion="rover")
    driver, agent = Driver(env), open_agent("dead-reckoning", env, params)
    fresh = driver.begin(params, agent, np.arange(3, dtype=np.uint32), np.arange(3))
    rides = fresh.state.parts["rover"]
    place = params.track.position[rides.anchor] + rides.body.qpos[:, :3]
    np.testing.assert_array_equal(params.track.tunnel[rides.anchor], [0, 1, 2])
    np.testing.assert_allclose(place[:, :2], fresh.state.position, atol=0.02)
    check(__file__, "stack", named((fresh.state, params.track)))


def test_a_wall_ends_its_episode_by_contact(task):
    _, _, go = task
    _, outcome = go([(1.0, 0.5)] * 60)
    ends = [bool(step[2]) for step in outcome]
    info = outcome[ends.index(True)][4]
    assert [bool(info[name]) for name in ("contact", "success", "fall")] == [True, False, False]


def test_what_it_cannot_do_is_refused_in_a_sentence(plans, plan_of):
    floor, _ = plans
    narrow = plan_of(tunnel_arrays(straight(40.0), half_width=0.4))
    ask = lambda **options: st.make(ID, motion="rover", **options)  # noqa: E731
    with pytest.raises(ValueError, match="TraverseShort-v1 has no motion 'hover'; it has wheels, rover"):
        st.make(ID, motion="hover")
    with pytest.raises(ValueError, match="B2Walk-v1 has no motion 'rover'; it has legs"):
        st.make("Subterra/B2Walk-v1", motion="rover")
    with pytest.raises(RobotError, match=r"is 0\.80 m wide at 0\.0 m; the rover needs 0\.90 m"):
        ask(tunnel=narrow)
    with pytest.raises(ValueError, match=r"start\.lateral = 1\.8 m may put the rover into a wall"):
        ask(tunnel=floor, start=StartParams(lateral=1.8))
    with pytest.raises(ValueError, match="a ready Tunnel holds no heights"):
        ask(tunnel=Tunnel.from_plan(floor))
    with pytest.raises(ValueError, match="no engine 'bullet'; there are mjx, mjx-jax, mjx-warp, mujoco"):
        ask(tunnel=floor, engine="bullet")
    with pytest.raises(ValueError, match="drives in one tunnel, got 2"):
        ask(tunnel=[floor, floor], engine="mujoco")
