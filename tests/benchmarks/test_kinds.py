"""The table of kinds, the pictures of linings and the atlas: what they count, and that they are written."""

import json

import numpy as np
import pytest
from PIL import Image

import subterra_jax as st
from benchmarks import atlas, kinds, linings
from subterra_jax.evaluation import Records
from subterra_jax.evaluation.floor import floor
from subterra_jax.tunnel import Tunnel


def test_every_kind_has_the_same_episodes_spread_over_its_own_tunnels():
    config = kinds.KindsConfig(episodes=12, tunnels=3)
    episodes = kinds.draw_episodes(config, 4)
    assert len(episodes) == 48
    for kind in range(4):
        rows = slice(12 * kind, 12 * kind + 12)
        np.testing.assert_array_equal(episodes.seed[rows], episodes.seed[:12])
        assert set(episodes.tunnel[rows]) == {3 * kind, 3 * kind + 1, 3 * kind + 2}
    assert len(set(episodes.seed[:12])) == 12
    assert episodes.seed.max() < 2**30, "a listed episode lies above"
    other = kinds.draw_episodes(kinds.KindsConfig(episodes=12, tunnels=3, split="test-seen"), 4)
    assert not set(other.seed) & set(episodes.seed)


def test_further_tunnels_are_columns_of_their_own_and_severities_are_spread_over_all_tunnels():
    config = kinds.KindsConfig(episodes=25, tunnels=5, further=("subterra-351", "control"))
    episodes = kinds.draw_episodes(config, 4, 2, faults=True)
    np.testing.assert_array_equal(kinds.column_of(episodes.tunnel, config), np.repeat(np.arange(6), 25))
    for tunnel in np.unique(episodes.tunnel):
        severities = episodes.severity[episodes.tunnel == tunnel]
        assert set(np.bincount(severities, minlength=5)) == {len(severities) // 5}
    alone = kinds.KindsConfig(episodes=3, tunnels=0, further=("subterra-351", "control"))
    assert kinds.column_of(kinds.draw_episodes(alone, 0, 2).tunnel, alone).tolist() == [0, 0, 0, 1, 1, 1]


def test_the_floor_is_that_of_each_columns_tunnels():
    config = kinds.KindsConfig(tunnels=0, further=("subterra-351", "control"))
    tunnels = [Tunnel.from_plan(plan, plan.default_lining) for plan in map(st.load_tunnel, config.further)]
    _, params = st.make("Subterra/StopAt-v1", tunnel=tunnels, hidden_start=True)
    low = kinds.floors(params, config, 2)
    assert low == pytest.approx([floor(params, 0), floor(params, 1)], abs=1e-3)
    assert 0.1 < low[0] < 0.3


def test_success_is_counted_by_kind():
    config = kinds.KindsConfig(episodes=4, tunnels=2)
    episodes = kinds.draw_episodes(config, 2)
    nothing = np.full(8, np.nan)
    plain = {
        name: nothing
        for name in Records.__dataclass_fields__
        if name not in ("seed", "tunnel", "severity", "group", "success", "contact", "goal_error")
    }
    records = Records(
        **vars(episodes),
        **plain,
        success=np.array([1, 1, 1, 0, 0, 0, 0, 0], bool),
        contact=np.array([0, 0, 0, 0, 0, 0, 1, 1], bool),
        goal_error=np.array([0.1, -0.3, 0.2, 9.0, 3.0, -5.0, 1.0, 1.0]),
    )
    first, second = (kinds.summary(records, config, kind) for kind in range(2))
    assert (first["success"], second["success"]) == (0.75, 0.0)
    assert first["low"] <= 0.75 <= first["high"]
    assert first["median_error"] == pytest.approx(0.25)
    assert (second["contact"], second["median_error"]) == (0.5, 4.0)  # those that touched a wall did not stop
    assert first["by_tunnel"] == [1.0, 0.5]


def test_a_picture_of_a_kind_is_written(tmp_path):
    linings.run(linings.LiningsConfig(kinds=("cast",), length=24.0, out=tmp_path))
    picture = np.asarray(Image.open(tmp_path / "cast.png").convert("L"))
    assert picture.shape == (400, 880)
    assert picture.std() > 10.0


def test_an_atlas_is_written_with_null_where_walls_tell_nothing(tmp_path, capsys):
    atlas.run(atlas.AtlasConfig("control", step=2.0, out=tmp_path))
    found = json.loads((tmp_path / "atlas.json").read_text())["atlas"]["smooth, planar"]
    inside = [b for s, b in zip(found["station"], found["station_bound"], strict=True) if 40.0 < s < 310.0]
    assert inside
    assert set(inside) == {None}
    assert "nothing in 100 % of the cells" in capsys.readouterr().out
    assert Image.open(tmp_path / "atlas.png").size == (1100, 616)


def test_an_agent_without_a_map_of_its_own_cannot_be_driven_without_one():
    env, params = st.make("Subterra/StopAt-v1")
    with pytest.raises(kinds.BenchmarkError, match="nomap:locate-transformer: has no map to go without"):
        kinds.make_agent("nomap:locate-transformer", env, params)
    with pytest.raises(kinds.BenchmarkError, match="nomap:fused: only a learnt localiser can be cut"):
        kinds.make_agent("nomap:fused", env, params)
    kinds.check(kinds.KindsConfig(agents=("nomap:locate-transformer", "cut:locate-transformer")))
