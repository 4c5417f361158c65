"""Models are what they were; drawn tunnels are those that boards and policies were scored on (see `tests.recorded`)."""

from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.b2.model import robot_spec
from subterra_jax.baselines.registry import make_agent, names
from subterra_jax.host.rover import rover_mjcf
from subterra_jax.physics.ground import read_track
from subterra_jax.physics.stage import tunnel_world
from subterra_jax.procedural import open_world
from subterra_jax.procedural.kinds import KINDS
from subterra_jax.tunnel.tunnel import stack
from tests.recorded import arrays_of, check
from tests.subterra_jax.test_arrays import bend
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


def uneven():
    """A bend between walls of unlike vertices, one longer than the other, with niches, one undercut, and furniture."""
    left, right = bend(40.0, offset=2.4)[:-1], bend(40.0, offset=-2.9)[:, :]
    niche = [[5.0, 0.0], [4.6, 1.2], [7.4, 1.2], [7.0, 0.0]]
    left = np.concatenate([left[:1], left[:1] + niche, left[1:], np.linspace(left[-1], bend(40.0, offset=2.4)[-1], 9)])
    return st.tunnel.from_polylines(
        left, right, furniture=[[20.0, -1.5, 21.0, -1.5], [21.0, -1.5, 21.0, -2.0]], elevation=0.5, ring_pitch=1.2
    )


def drawn_by_hand():
    line = bend(60.0)
    width, height = np.linspace(2.0, 3.0, len(line)), np.linspace(-1.0, 2.0, len(line))
    pockets = [[20.0, 1, 0.4, 0.3], [50.0, 1, 0.6, 0.2], [50.0, -1, 0.2, 0.1]]
    return st.tunnel.from_centreline(line, width, pockets=pockets, elevation=height, lidar_height=0.5, ring_pitch=1.5)


BY_HAND = {"uneven": uneven, "hand": drawn_by_hand}
ON_DEVICE = {
    "pockets": lambda: (st.load_tunnel().slice(101.3, 40.0), "pockets"),
    "furnished": lambda: (st.load_tunnel("metro").slice(40.0, 33.3), "furnished"),
    "refuges": lambda: (st.load_tunnel("open:masonry:train:0").slice(100.0, 20.0), "built"),
    **{name: lambda name=name: (BY_HAND[name](), None) for name in BY_HAND},
}


def on_device(tunnel):
    """Arrays of a tunnel on the device; its padding by its place alone."""
    box = np.asarray(tunnel.box)
    there = box[4] > 0.0
    halves = np.ascontiguousarray(tunnel.packed.block).view(np.uint16).reshape(-1, 16)[there]
    near = ["length", "spacing", "ring_pitch", "texture", "reach", "n_scan", "n_contact", "n_candidates"]
    return {
        **{name: np.asarray(getattr(tunnel, name), float) for name in (*near, "first_node", "n_nodes")},
        **{name: np.asarray(getattr(tunnel, name)) for name in ("grid", "scan_first", "contact_first", "visit_first")},
        "box": dict(enumerate(box[:, there])),
        "wall": np.asarray(tunnel.wall)[there],
        "padding": (np.flatnonzero(~there), box[:, ~there][[0, 1, 4, 6]]),
        "packed": {"block": dict(enumerate(halves.T[:13])), "wall": np.asarray(tunnel.packed.wall)},
    }


@pytest.mark.parametrize("name", ON_DEVICE)
def test_a_tunnel_goes_to_the_device_as_it_did(name):
    plan, lining = ON_DEVICE[name]()
    check(TABLE, f"device {name}", on_device(st.Tunnel.from_plan(plan, lining)))


def test_a_stack_goes_to_the_device_as_it_did():
    check(TABLE, "device stack", on_device(stack([st.Tunnel.from_plan(*make()) for make in ON_DEVICE.values()])))


@pytest.mark.parametrize("name", BY_HAND)
def test_a_tunnel_from_arrays_is_what_it_was(name):
    check(TABLE, f"plan {name}", BY_HAND[name]())
