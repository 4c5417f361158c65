"""The agents of the board, one line each: to add an agent is to add its line.

What is named on the command line drives without a line here too, and stands under its own name.
"""

import dataclasses
from typing import Any, Literal

from benchmarks.command import BenchmarkError
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.policies.opening import open_agent
from subterra_jax.state import EnvParams

Group = Literal["blind", "written", "learnt", "reward", "map", "ceiling", "truth", "other"]
PLANAR = SENSORS[0]
_TUNED = "`subterra-351` and generated tunnels, none of the open world"
_TRAINED, _MAPPED = "`open:…:train`", "`open:…:train`; has the map"
_STOPS = ("StopAt",)
CUT, NO_MAP = "cut:", "nomap:"  # before a learnt localiser: without what the walls tell, or without its map


@dataclasses.dataclass(frozen=True)
class Entry:
    """An agent of the board.

    Attributes:
        name: Its name: a baseline, a released policy, a policy's file, or code as `FILE.py:Class`.
        group: `blind` steers by the walls and never localises by them; `written` and `learnt` go without a map, and
            `reward` is learnt by reward alone; `map` has the map; `ceiling` and `truth` know what nobody is given.
        tuned: What it was tuned on or trained with.
        tasks: Tasks that it drives; none named is all.
        hidden: Whether it drives with a hidden start too.
        sensor: Its LiDAR.
    """

    name: str
    group: Group
    tuned: str
    tasks: tuple[str, ...] = ()
    hidden: bool = True
    sensor: str = PLANAR


ROSTER = (
    Entry("random", "blind", "nothing"),
    Entry("dead-reckoning", "blind", "nothing"),
    Entry("fused", "blind", "nothing; given the sizes of the errors"),
    Entry("scan-matching", "written", _TUNED),
    Entry("locate-transformer", "learnt", _TRAINED, _STOPS, hidden=False),
    Entry("StopAt-v1", "learnt", f"{_TRAINED}; its speed, steering and stop by reward", _STOPS, hidden=False),
    Entry("Return-locate", "learnt", f"{_TRAINED}; its speed, steering and stop by reward", ("Return",), hidden=False),
    Entry("locate-obstructed", "learnt", _TRAINED, ("Obstructed",), hidden=False),
    Entry("locate-faulted", "learnt", _TRAINED, ("Faulted",), hidden=False),
    Entry("StopAt-plain", "reward", f"{_TRAINED}; by reward alone", _STOPS, hidden=False),
    Entry("Return-v1", "reward", f"{_TRAINED}; by reward alone", ("Return",), hidden=False),
    Entry("locate-spin", "learnt", f"{_TRAINED}; reads `spin16x64`", _STOPS, hidden=False, sensor="spin16x64"),
    Entry("nomap:locate-map", "learnt", f"{_TRAINED}; its map is hidden", _STOPS),
    Entry("locate-map", "map", _MAPPED, _STOPS),
    Entry("particle-filter", "map", f"{_TUNED}; has the map"),
    Entry("histogram-filter", "map", "nothing; has the map, given the sizes of the errors"),
    Entry("ceiling", "ceiling", "nothing; has the map, the sizes of errors and of the episode's faults"),
    Entry("oracle", "truth", "nothing; given the truth"),
)
_BY_NAME = {entry.name: entry for entry in ROSTER}


def entry_of(name: str) -> Entry:
    """Return the line of an agent; one of its own for an agent that has none."""
    return _BY_NAME.get(name, Entry(name, "other", "not known"))


def bare(name: str) -> str:
    """Return the name of an agent without the prefix that says what it is to do without."""
    return name.removeprefix(CUT).removeprefix(NO_MAP)


def make_agent(name: str, env: Any, params: EnvParams) -> Any:
    """Make an agent by its name.

    Raises:
        BenchmarkError: It has nothing to do without.
        SubterraError: There is no such agent or policy, or it does not fit the task.
    """
    agent: Any = open_agent(bare(name), env, params)
    if name == bare(name):
        return agent
    method, lacks = ("without_walls", "walls") if name.startswith(CUT) else ("without_map", "map")
    if not hasattr(agent, method) or (name.startswith(NO_MAP) and not agent.takes_map):
        raise BenchmarkError(f"{name}: {bare(name)} has no {lacks} to go without; a learnt localiser has")
    return getattr(agent, method)()
