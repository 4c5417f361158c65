"""Navigation for the B2: learnt on a planar robot that obeys late; `benchmarks.b2_traverse` tries it on four legs."""

from pathlib import Path
from typing import Any

import subterra_jax as st
from subterra_jax.b2 import tasks, transfer
from subterra_jax.parts.slip import SlipParams
from train.config import ConfigError
from train.world import World, require_task
from train.world import open_world as open_planar_world

B2 = "b2"
TASKS = ("Subterra/Traverse-v1", "Subterra/TraverseShort-v1")
# A gait is no motor: it walks a tenth faster or slower than reported, and a little askew.
_SLIP = SlipParams(gain_sigma=0.1, yaw_sigma=0.02)


def open_world(task: str, tunnel: Path | str | None, lining: str | None) -> World:
    """Opens a task on the planar stand-in of the B2.

    Raises:
        ConfigError: The B2 does not do this task, or the tunnel is more than one.
        SubterraError: As `train.world.open_world`.
    """
    task = require_task(task)
    if task not in TASKS:
        raise ConfigError(f"the B2 does not do {task!r}; it does {', '.join(TASKS)}")
    planar = open_planar_world(task, tunnel, lining)
    if planar.params.tunnel.count > 1:
        raise ConfigError(f"tunnel = {tunnel} is more than one; the B2 walks one")
    fields: dict[str, Any] = {"vehicle": tasks.VEHICLE, "start": tasks.START, "slip": _SLIP}
    env, params = st.make(task, tunnel, planar.facts["lining"], **fields)
    return World(task, transfer.stand_in(env), params, {**planar.facts, "motion": B2})
