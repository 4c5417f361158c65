"""Models are what they were; drawn tunnels are those that boards and policies were scored on (see `tests.recorded`)."""

from pathlib import Path
from xml.etree import ElementTree

import mujoco
import pytest

import subterra_jax as st
from subterra_jax.b2.model import robot_spec
from subterra_jax.baselines.registry import make_agent, names
from subterra_jax.host.rover import rover_mjcf
from subterra_jax.physics.ground import read_track
from subterra_jax.physics.stage import tunnel_world
from subterra_jax.procedural import open_world
from subterra_jax.procedural.kinds import KINDS
from tests.recorded import arrays_of, check
from tests.subterra_jax.test_open_world import name_of

TABLE = Path(__file__).with_name("values.csv")
ON_A_WALKWAY = (("universal", 5), ("universal", 30), ("cast", 18))  # the plane cuts one, which is the wall there
AGENTS = names()  # of the package: tests register more


@pytest.mark.parametrize(("kind", "index"), [*((kind, 0) for kind in KINDS), *ON_A_WALKWAY, ("masonry", 7)])
def test_a_tunnel_is_drawn_as_it_was(kind, index):
    name = name_of(kind, index)
    drawn = open_world.draw(name, 40.0)
    grid = {name: one for name, one in vars(drawn.bore).items() if name not in ("kind", "layers")}
    plan = open_world.plan(name, length=40.0)
    told = {"items": drawn.items, "line": drawn.alignment, "grade": drawn.grade, "bore": grid, "shell": plan.shell}
    check(TABLE, f"{kind}-{index}", {**told, "half_width": plan.half_width, "walls": plan.linings})


MODELS = {
    "b2": robot_spec,
    "rover": lambda: mujoco.MjSpec.from_string(ElementTree.tostring(rover_mjcf(), "unicode")),
    "world": lambda: tunnel_world(plan := st.load_tunnel("subterra-351"), read_track(plan)),
}


@pytest.mark.parametrize("name", MODELS)
def test_a_model_for_mujoco_is_what_it_was(name):
    check(TABLE, name, arrays_of(MODELS[name]().compile()))


@pytest.mark.parametrize("task", ["StopAt", "Relocalise", "Faulted"])
def test_agents_are_set_as_they_were(task):
    _, params = st.make(f"Subterra/{task}-v1", "control")
    check(TABLE, f"agents {task}", {name: make_agent(name, params) for name in AGENTS})
