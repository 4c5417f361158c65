"""Many tunnels at once: those of a world are the ones that a task makes of their plans."""

import hashlib

import jax
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.host.versions import VERSION
from train import tunnels
from train.world import open_world


def test_no_tunnel_and_one_tunnel_need_no_other_process():
    assert tunnels.load([]) == []
    (one,) = tunnels.load(["control"], "smooth")
    assert one.count == 1


@pytest.mark.parametrize(
    ("task", "sensor"),
    [
        ("StopAtShort-v1", "planar16"),  # a piece is cut out of each
        pytest.param("StopAt-v1", "spin16x64", marks=pytest.mark.slow),  # two processes
    ],
)
def test_a_world_of_several_tunnels_is_that_of_their_plans(task, sensor):
    names = ["open:straight:train:2", "open:straight:train:3"]
    world = open_world(f"Subterra/{task}", "open:straight:train:2-3", sensor=sensor)
    plans = [st.load_tunnel(name, solid=sensor != "planar16") for name in names]
    _, params = st.make(f"Subterra/{task}", tunnel=plans, lining=plans[0].default_lining, sensor=sensor)
    assert jax.tree.structure(world.params) == jax.tree.structure(params)
    for one, other in zip(jax.tree.leaves(world.params), jax.tree.leaves(params), strict=True):
        np.testing.assert_array_equal(one, other)
    digest = hashlib.sha256("\n".join(f"{name} {VERSION}" for name in names).encode()).hexdigest()
    assert world.facts["tunnel_sha256"] == digest
    assert world.facts["tunnel"] == "open:straight:train:2-3"
