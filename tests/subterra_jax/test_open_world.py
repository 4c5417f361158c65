"""Tunnels of every kind of lining: what is drawn, what is reported, which split has what, and the cut by the plane."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax.procedural import expand, open_world
from subterra_jax.procedural.bore import draw_bore
from subterra_jax.procedural.kinds import KINDS
from subterra_jax.procedural.open_world import HELD_OUT, SPLITS, draw, kinds_of, levels_of, plan
from subterra_jax.procedural.surfaces import Grid, Rings, Stretches, Waves
from tests.subterra_jax.test_lidar import check_exact

UNSEEN_KINDS = tuple(kind for kind in KINDS if kind not in HELD_OUT)
SHORT = 60.0  # m of tunnel, enough for most of what is asked here


def name_of(kind: str, index: int = 0) -> str:
    return f"open:{kind}:{'test-unseen' if kind in UNSEEN_KINDS else 'train'}:{900_000 + index}"


@pytest.fixture(scope="module")
def drawn() -> dict:
    return {kind: draw(name_of(kind), 200.0) for kind in KINDS}


def test_what_is_unseen_is_in_no_other_split():
    assert set(kinds_of("test-unseen")) == set(KINDS)
    for split in ("train", "val", "test-seen"):
        assert kinds_of(split) == tuple(HELD_OUT)
        for kind in HELD_OUT:
            assert not set(levels_of(kind, split)) & set(levels_of(kind, "test-unseen"))
            assert set(levels_of(kind, split)) | set(levels_of(kind, "test-unseen")) == {"none", "some", "all"}
    seen = {draw(f"open:cast:val:{i}", 30.0).furniture for i in range(12)}
    assert seen == {"some", "all"}
    assert draw("open:cast:test-unseen:3", 30.0).furniture == "none"
    firsts = sorted(SPLITS.values())
    assert min(np.diff(firsts)) >= open_world.SPLIT_SIZE


def test_a_split_has_its_kinds_in_turn_and_a_range_of_names_is_their_list():
    names = expand("open:val:0-5")
    assert names == [f"open:val:{i}" for i in range(6)]
    kinds = [draw(name, 30.0).bore.kind.name for name in names]
    assert kinds == [*HELD_OUT, *list(HELD_OUT)[:2]]
    assert expand("open:cast:test-seen:3-4") == ["open:cast:test-seen:3", "open:cast:test-seen:4"]
    own, by_kind = plan("open:val:1", solid=False, length=SHORT), plan("open:cast:val:1", solid=False, length=SHORT)
    np.testing.assert_array_equal(own.lining("built").segments, by_kind.lining("built").segments)
    other = plan("open:cast:train:1", solid=False, length=SHORT)
    assert other.lidar_height != own.lidar_height


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("open:brick:val:0", "there is no kind 'brick'; there are straight, universal, cast"),
        ("open:cast:dev:0", "there is no split 'dev'; there are train, val, test-seen, test-unseen"),
        ("open:rock:val:0", "'rock' is in test-unseen alone; 'val' has straight, cast"),
        ("open:cast:val:1000000", "has tunnels 0 to 999999"),
        ("open:cast:val:x", "open:SPLIT:INDEX or open:KIND:SPLIT:INDEX"),
        ("open:val:3-1", "1 comes before 3"),
    ],
)
def test_a_tunnel_that_is_not_there_is_refused_in_one_sentence(name, said):
    with pytest.raises(st.TunnelError, match=said) as error:
        st.make("Subterra/StopAt-v1", tunnel=name)
    assert "\n" not in str(error.value)


def test_a_task_longer_than_its_tunnel_is_refused_with_both_lengths():
    short = plan(name_of("cast"), solid=False, length=40.0)
    with pytest.raises(ValueError, match=r"needs a tunnel of 140 m, this one has 40\.0 m"):
        st.make("Subterra/StopAt-v1", tunnel=short)


@pytest.mark.parametrize("kind", ["straight", "universal"])
def test_the_nominal_ring_length_is_told_and_the_built_one_is_a_little_longer(kind):
    excess, spread = [], []
    for i in range(12):
        drawn = draw(name_of(kind, i), 400.0)
        rings = drawn.bore.rings
        lengths = np.diff(rings.joint)
        excess.append(lengths.mean() / rings.nominal - 1.0)
        spread.append(lengths.std())
        assert 1.0 <= rings.nominal == round(rings.nominal, 2) <= 2.0
    assert -2e-4 < min(excess) < 4e-4 < np.mean(excess) < 1.6e-3 < max(excess) < 2.2e-3
    assert np.mean(spread) == pytest.approx(1e-3, rel=0.1)
    tunnel = plan(name_of(kind), solid=False, length=120.0)
    rings = draw(name_of(kind), 120.0).bore.rings
    outcome = st.make("Subterra/StopAtShort-v1", tunnel=tunnel)[1].tunnel.ring_pitch  # the entry of the observation
    assert float(outcome) == pytest.approx(rings.nominal, abs=1e-6)


def test_nothing_is_placed_where_a_sensor_looks():
    """Another mount leaves every pocket and box in its place, and a plane meets a row of pockets only now and then."""
    met = []
    for i in range(30):
        streams = lambda mount, i=i: [np.random.default_rng([i, k]) for k in (0, 1, 2, 3, mount)]  # noqa: E731
        one, two = (draw_bore(KINDS["straight"], 40.0, ("cabinet", "bracket"), streams(mount)) for mount in (4, 5))
        assert one.mount != two.mount
        np.testing.assert_array_equal(one.pocket, two.pocket)
        for a, b in zip(vars(one.furniture).values(), vars(two.furniture).values(), strict=True):
            np.testing.assert_array_equal(a, b)
        plane = one.mount.plane(np.where(np.cos(one.pocket[:, 1]) > 0.0, 1.0, -1.0) * one.section.half_width)
        met.append(np.any(np.abs(one.heights_of(one.pocket) - plane) < 0.05))
    assert 3 <= np.sum(met) <= 24


def test_mounts_cover_their_range():
    mounts = [draw(name_of("cast", i), 30.0).bore.mount for i in range(40)]
    height = [mount.height for mount in mounts]
    assert 0.4 <= min(height) < 0.5 < 1.1 < max(height) <= 1.2
    assert 0.01 < np.std([mount.roll for mount in mounts]) < 0.03
    assert np.std([mount.lateral for mount in mounts]) == pytest.approx(0.6 / 12**0.5, rel=0.35)


def test_straight_joints_line_up_and_those_of_universal_rings_turn(drawn):
    """Pockets of the joints within a ring, in the middle of each, stand at one set of angles or at many."""

    def angles(kind: str) -> int:
        bore = drawn[kind].bore
        joint = np.concatenate([[0.0], bore.rings.joint, [200.0]])
        middle = 0.5 * (joint[1:] + joint[:-1])
        in_ring = np.abs(bore.pocket[:, 0, None] - middle).min(axis=1) < 1e-6
        return len(np.unique(np.round(bore.pocket[in_ring, 1], 3)))

    assert 0 < angles("straight") <= 14
    assert angles("universal") > 14


def test_a_random_surface_has_its_standard_deviation_and_correlation_length_both_ways():
    station, girth = np.arange(0.0, 400.0, 0.1), np.arange(0.0, 3.0, 0.1)
    grid = Grid(station, girth, girth, girth)
    rows = [Waves.draw(np.random.default_rng(i), 0.04, 0.8).relief(grid, np.arange(30)) for i in range(8)]
    assert np.std(rows) == pytest.approx(0.04, rel=0.05)
    for axis in (0, 1):
        pairs = [(row[8:], row[:-8]) if axis == 0 else (row[:, 8:], row[:, :-8]) for row in rows]
        lag = np.mean([np.mean(a * b) for a, b in pairs]) / 0.04**2
        assert lag == pytest.approx(np.exp(-1.0), abs=0.06)


def test_a_random_surface_is_the_sum_of_its_cosines_to_a_nanometre_and_does_not_depend_on_the_order_of_sums():
    grid = Grid(0.125 * np.arange(700), np.zeros(40), np.zeros(40), np.linspace(-8.0, 8.0, 40))
    waves, columns = Waves.draw(np.random.default_rng(2), 0.06, 0.8), np.array([3, 17, 39])
    phase = np.multiply.outer(grid.station, waves.frequency[:, 0])[:, None] + (
        grid.girth[columns, None] * waves.frequency[:, 1] + waves.phase
    )
    found = waves.relief(grid, columns)
    assert np.abs(found - waves.amplitude * np.cos(phase).sum(axis=-1)).max() < 0.6e-9
    np.testing.assert_array_equal(found, np.round(found, 9))


def test_walls_have_the_steps_and_roughness_of_their_kind(drawn):
    rough = {}
    for kind, one in drawn.items():
        bore = one.bore
        columns = np.array([90 - 20, 20])  # to either side of the crown
        relief = bore.radius(columns) - bore.radius(columns, smooth=True)
        rough[kind] = float(np.std(relief))
    assert max(rough["straight"], rough["universal"], rough["cast"]) < 0.02
    assert rough["sprayed"] > 0.03
    assert rough["rock"] > 0.05
    stretches = next(layer for layer in drawn["cast"].bore.layers if isinstance(layer, Stretches))
    lengths = np.diff(stretches.joint)
    assert np.all((lengths > 5.9) & (lengths < 12.2))
    rounds = next(layer for layer in drawn["sprayed"].bore.layers if isinstance(layer, Stretches))
    assert 0.1 <= rounds.flare <= 0.3
    assert 0.7 < np.diff(rounds.joint).mean() < 3.1
    assert not any(isinstance(layer, Rings) for layer in drawn["sprayed"].bore.layers)


def test_a_round_of_blasting_widens_from_its_joint_to_the_next():
    rounds = Stretches(np.array([2.0, 5.0]), np.zeros(3), np.zeros((3, 2)), 0.2)
    grid = Grid(np.array([0.0, 1.0, 2.0, 2.001, 3.5, 5.0, 6.0]), *np.zeros((3, 1)))
    along = rounds.relief(grid, np.array([0]))[:, 0]
    np.testing.assert_allclose(along, [-0.1, 0.0, 0.1, -0.1, 0.0, 0.1, 0.1], atol=2e-4)


def test_a_masonry_tunnel_has_refuges_every_20_to_30_m_on_either_side(drawn):
    niche = drawn["masonry"].bore.niche
    for side in (1.0, -1.0):
        own = np.sort(niche[np.sign(np.cos(niche[:, 1])) == side, 0])
        assert len(own) >= 5
        assert 17.0 < np.diff(own).mean() < 33.0


def test_furniture_is_none_some_or_all():
    levels = {level: [] for level in open_world.LEVELS}
    for i in range(14):
        one = draw(name_of("universal", i), 300.0)
        levels[one.furniture].append(len(one.items))
        assert len(one.bore.furniture.start) + len(one.bore.recess) + len(one.bore.benches) > 0 or not one.items
    assert set(levels["none"]) == {0}
    assert set(levels["all"]) == {len(KINDS["universal"].fixtures)}
    assert 0 < np.mean(levels["some"]) < len(KINDS["universal"].fixtures)


@pytest.mark.parametrize("kind", ["rock", "straight"])
def test_scans_are_exact(kind):
    check_exact(plan(name_of(kind, 1), solid=False, length=150.0), "built", 1500)


def test_a_robot_fits_between_the_walls_of_every_kind():
    for kind in KINDS:
        tunnel = plan(name_of(kind, 2), solid=False, length=120.0)
        segments = tunnel.lining("built").segments
        for lateral in (-0.5, 0.0, 0.5):
            normal = np.stack([-tunnel.tangent[:, 1], tunnel.tangent[:, 0]], axis=-1)
            assert reference.clearance(segments, (tunnel.centre + lateral * normal)[8:-8:8]).min() > 0.5, kind


def check_cut(kind: str, variant: str, length: float) -> np.ndarray:
    """Differences of beams in the plane between the plan and the shell's triangles, by embree, m."""
    embree = pytest.importorskip("trimesh.ray.ray_pyembree")
    import trimesh

    from subterra_jax.lidar3d.rolled import raise_shell

    tunnel = plan(name_of(kind), length=length, variants=(variant,))
    mount = draw(name_of(kind), length).bore.mount
    _, surface = raise_shell(tunnel.shell, variant)
    mesh = embree.RayMeshIntersector(trimesh.Trimesh(surface.vertices, surface.faces, process=False))
    rng = np.random.default_rng(0)
    station = rng.uniform(8.0, length - 8.0, 3000)
    at = lambda values: np.interp(station, tunnel.station, values)  # noqa: E731
    centre, ahead = (np.stack([at(column) for column in v.T], axis=-1) for v in (tunnel.centre, tunnel.tangent))
    turn = rng.uniform(0.35, np.pi - 0.35, 3000) * rng.choice([-1.0, 1.0], 3000)
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    level = cos * ahead + sin * np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
    planar = reference.cast(tunnel.lining(variant).segments, centre, level)[0]
    grade = at(np.gradient(tunnel.elevation, tunnel.station))
    tilted = np.column_stack([level, cos[:, 0] * grade + sin[:, 0] * np.tan(mount.roll)])
    size = np.linalg.norm(tilted, axis=1)
    origin = np.column_stack([centre, at(tunnel.elevation) + mount.plane(0.0)])
    place, ray, _ = mesh.intersects_location(origin, tilted / size[:, None], multiple_hits=False)
    solid = np.full(3000, np.inf)
    solid[ray] = np.linalg.norm(place - origin[ray], axis=1)
    return np.abs(np.minimum(solid / size, 30.0) - np.minimum(planar, 30.0))


def test_the_plan_is_the_cut_of_the_shell():
    error = check_cut("cast", "built", 40.0)
    assert np.median(error) < 0.002
    assert np.mean(error > 0.02) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["built", "bare", "smooth"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_plan_of_every_kind_is_the_cut_of_its_shell(kind, variant):
    """Triangles round off the ramps where rounds end; the plane may graze the rim of a pocket."""
    error = check_cut(kind, variant, 70.0)
    rounds = variant != "smooth" and kind in ("sprayed", "rock")
    assert np.median(error) < (0.006 if rounds else 0.002)
    assert np.mean(error > 0.02) < (0.15 if rounds else 0.05)


def hostile(names: list[str], n_envs: int, n_steps: int) -> None:
    """Commands from NaN to infinity in tunnels of all kinds, started anew where an episode ends."""
    env, params = st.make("Subterra/StopAtShort-v1", tunnel=[plan(name, solid=False, length=90.0) for name in names])
    batch = st.AutoReset(env)
    values = jnp.array([-jnp.inf, -1e30, -3.0, -0.0, 1e-30, 0.7, 5.0, 1e30, jnp.inf, jnp.nan])

    @jax.jit
    def run(key):
        def step(carry, key):
            state, bad = carry
            draw_key, step_key = jax.random.split(key)
            action = values[jax.random.randint(draw_key, (n_envs, 2), 0, len(values))]
            out = batch.step(step_key, state, action, params)
            leaves = jax.tree.leaves((out[0], out[1], out[2]))
            bad = bad + sum(jnp.sum(~jnp.isfinite(leaf)) for leaf in leaves)
            return (out[1], bad), None

        reset_key, steps_key = jax.random.split(key)
        _, state = batch.reset(reset_key, params, n_envs)
        return jax.lax.scan(step, (state, jnp.zeros((), jnp.int32)), jax.random.split(steps_key, n_steps))[0][1]

    assert int(run(jax.random.key(0))) == 0


def test_a_hundred_thousand_hostile_steps_over_all_kinds_stay_finite():
    hostile([name_of(kind, 3) for kind in KINDS], 1000, 100)
