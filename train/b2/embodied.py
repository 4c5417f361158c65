"""Navigation for the B2: learnt on a planar robot that obeys late, then tried on four legs with a frozen gait."""

import dataclasses
from pathlib import Path
from typing import Any

import subterra_jax as st
from subterra_jax.b2 import tasks, transfer
from subterra_jax.parts.slip import SlipParams
from subterra_jax.tunnel.sources import load_tunnel
from train.config import ConfigError, Legs
from train.log import print_table
from train.policies import make_agent
from train.session import Session
from train.snapshot import Snapshot
from train.world import World, require_task
from train.world import open_world as open_planar_world

B2 = "b2"
ON_LEGS = "legs.json"  # what came of the trial, in the run folder
TASKS = ("Subterra/Traverse-v1", "Subterra/TraverseShort-v1")
# A gait is no motor: it walks a tenth faster or slower than reported, and a little askew.
_SLIP = SlipParams(gain_sigma=0.1, yaw_sigma=0.02)


def open_world(task: str, tunnel: Path | str | None, lining: str | None, legs: Legs) -> World:
    """Opens a task on the planar stand-in of the B2, and checks that the trial on legs could be opened.

    Raises:
        ConfigError: The B2 does not do this task, or the tunnel is more than one.
        SubterraError: As `tasks.make_mission`.
    """
    task = require_task(task)
    if task not in TASKS:
        raise ConfigError(f"the B2 does not do {task!r}; it does {', '.join(TASKS)}")
    if legs.robots < 0:
        raise ConfigError(f"robots must not be negative, got {legs.robots}")
    planar = open_planar_world(task, tunnel, lining)
    if planar.params.tunnel.count > 1:
        raise ConfigError(f"tunnel = {tunnel} is more than one; the B2 walks one")
    fields: dict[str, Any] = {"vehicle": tasks.VEHICLE, "start": tasks.START, "slip": _SLIP}
    env, params = st.make(task, tunnel, planar.facts["lining"], **fields)
    if legs.robots:
        _mission(planar, tunnel, legs)
    return World(task, transfer.stand_in(env), params, {**planar.facts, "embodiment": B2})


def score(session: Session, snapshot: Snapshot, tunnel: Path | str | None, legs: Legs) -> dict[str, float]:
    """Has robots walk under the policy that was kept; writes `legs.json` and prints the figures."""
    env, params = _mission(session.world, tunnel, legs)
    agent = make_agent(session.learner.driver, snapshot.policy)
    found = transfer.figures(*transfer.walk_robots(env, params, agent, legs.robots), params)
    session.folder.write_json(ON_LEGS, {**dataclasses.asdict(legs), **session.world.facts, **found})
    print_table(f"{session.world.task}: {legs.robots} B2s in {legs.engine}, gait {legs.gait}", found)
    return found


def _mission(world: World, tunnel: Path | str | None, legs: Legs) -> tuple[Any, Any]:
    """Opens the same task on legs."""
    plan = load_tunnel(tunnel)
    if (piece := st.TASKS[world.task].piece) is not None:
        start, length = piece
        plan = plan.slice(start, min(length, plan.length - start))
    return tasks.make_mission(tunnel=plan, lining=world.facts["lining"], policy=legs.gait, engine=legs.engine)
