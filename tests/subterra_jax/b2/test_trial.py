"""What is made of many robots' walks, and of one that is filmed."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.b2 import film, transfer
from subterra_jax.pictures.renderer import PictureError
from subterra_jax.tunnel_env import TunnelEnv
from tests.subterra_jax import probes

PARAMS = SimpleNamespace(
    start=SimpleNamespace(station=2.0), vehicle=SimpleNamespace(period=0.2), tunnel=SimpleNamespace(length=100.0)
)


def test_figures_of_four_robots_are_what_one_counts_by_hand():
    """Two arrive after 80 m in 100 s, one falls after 20 m in 50 s, one touches the wall where it stood."""
    state = SimpleNamespace(
        station=np.array([82.0, 82.0, 22.0, 2.0]),
        furthest=np.array([90.0, 90.0, 30.0, 10.0]),
        odometry=SimpleNamespace(distance=np.array([84.0, 76.0, 20.0, 0.0])),
    )
    walk = transfer.Walk(
        state=state,
        over=np.ones(4, bool),
        success=np.array([True, True, False, False]),
        contact=np.array([False, False, False, True]),
        fall=np.array([False, False, True, False]),
        steps=np.array([500, 500, 250, 1]),
    )
    told = transfer.figures(walk, np.array([0.3, -0.4]), PARAMS)
    assert told["robots"] == 4
    assert (told["success_percent"], told["fall_percent"], told["contact_percent"]) == (50.0, 25.0, 25.0)
    assert told["coverage_median_percent"] == pytest.approx(60.0)
    assert told["speed_mean"] == pytest.approx((0.8 + 0.8 + 0.4 + 0.0) / 4)
    assert told["lateral_rms"] == pytest.approx(np.sqrt(0.125))
    assert told["odometer_error_percent"] == pytest.approx(0.0)
    assert told["odometer_error_sigma_percent"] == pytest.approx(100.0 * np.sqrt(2 * 0.05**2 / 4))


def test_a_film_holds_its_pictures_and_says_so_where_it_cannot_be_written(tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    pictures = [np.full((8, 12, 3), shade, np.uint8) for shade in (0, 90, 180, 250)]
    film.write(tmp_path / "run.gif", pictures)
    assert imageio.imread(tmp_path / "run.gif").shape == (4, 8, 12, 3)
    with pytest.raises(PictureError, match="cannot be written"):
        film.write(tmp_path / "run.nothing", pictures)


def test_the_command_ends_with_one_sentence_where_the_gait_is_missing(capsys):
    assert film.main(["run.gif", "--policy", "nobody"]) == 2
    assert "error: nobody: no such policy" in capsys.readouterr().err


@dataclasses.dataclass(frozen=True)
class _Rolling(TunnelEnv):
    """An environment on wheels that says, as one on legs does, that nobody fell."""

    def advance(self, state, action, noise, params):
        *results, info = super().advance(state, action, noise, params)
        return (*results, {**info, "fall": jnp.zeros((), bool)})


@pytest.mark.parametrize("name", ["nothing", "truth"])
def test_a_robot_on_legs_is_driven_by_what_its_agent_declares_and_no_more(name):
    agent, speed = probes.PROBES[name]
    env, params = st.make("Subterra/TraverseShort-v1", horizon=3)
    walk, _ = transfer.walk_robots(_Rolling(env.id, env.rule), params, agent, 2)
    np.testing.assert_allclose(walk.state.command[:, 0], speed, rtol=1e-4)
