"""Release of a learnt localiser: its tensors, and a card that says what it learnt on and what it did where."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.host.files import replace_file
from subterra_jax.policies.files import TENSORS
from train.config import ConfigError
from train.evaluate import evaluate
from train.locate.keeping import CURVE, POLICY, SCORES
from train.locate.scores import WITH_MAP
from train.policies import facts_file
from train.tunnels import PLANAR
from train.world import open_world

MEASURED = ("subterra.kinds/1", "subterra.look/1")
INPUTS = "odometer, own commands, start and goal; no ring length, no counter of rings"
NO_MAP, A_MAP = "no map", "a map if there is one: the walls in the plane of the LiDAR"
_SEES = {PLANAR: "16 level ranges"}
LEARNT = "where the robot is; steering, avoidance and the stop are written"
_CASES = ("cut", "nomap", *WITH_MAP)


def is_localiser(folder: Path) -> bool:
    """Tells whether a folder is one of a seed of `train.locate`."""
    return (folder / POLICY).is_file()


def release(folder: Path, out: Path, episodes: int, measured: tuple[Path, ...]) -> dict[str, Any]:
    """Writes tensors and card of a trained localiser.

    Args:
        folder: Folder of a seed.
        out: The tensors' file; the card goes beside it.
        episodes: Listed episodes of its task that are driven for the card.
        measured: Tables of `benchmarks.kinds` and `train.locate.look`, of which the card takes the rows of this policy.

    Returns:
        Scores on the listed episodes.

    Raises:
        ConfigError: A table is none, or does not have this policy; or the folder lacks its scores.
        PolicyError: The policy is damaged.
    """
    agent, facts = policies.load(folder / POLICY)
    tensors = (folder / POLICY).read_bytes()
    rows = [_rows(path, facts["tensors_sha256"]) for path in measured]
    curve, scores = _curve(folder), _read(folder / SCORES, "scores")
    sensor = facts.get("world", {}).get("sensor", PLANAR)
    world = open_world(facts["task"], None, None, sensor)
    found = evaluate(world, dataclasses.replace(agent, name=out.name.removesuffix(TENSORS)), episodes)
    card = {
        **facts,
        "name": out.name.removesuffix(TENSORS),
        "constants_sha256": st.constants_digest(),
        "world": {"tunnel": facts["tunnels"], "lining": None, "sensor": sensor},
        "inputs": f"{_SEES.get(sensor, f'the image of {sensor}')}, {INPUTS}; {A_MAP if agent.takes_map else NO_MAP}",
        "learnt": LEARNT,
        "val": scores,
        "success_against_time": curve,
        "measured": rows,
        "scores": {**world.facts, **found},
    }
    for place, data in ((out, tensors), (facts_file(out), f"{json.dumps(card, indent=1)}\n".encode())):
        with replace_file(place) as fresh:
            fresh.write_bytes(data)
    return found


def _curve(folder: Path) -> list[list[float]]:
    """Returns seconds of training, and the share of goals in `val` at which it was right to 1 m."""
    try:
        lines = [json.loads(line) for line in (folder / CURVE).read_text().splitlines()]
        return [[line["seconds"], round(line["within"], 4)] for line in lines]
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{folder}: no readable {CURVE} in it") from error


def _case(agent: str) -> str:
    """Returns how a policy drove or was asked, by the prefix of its name in a table."""
    case = agent.partition(":")[0] if ":" in agent else ""
    return case if case in _CASES else "as it is"


def _read(path: Path, field: str) -> Any:
    try:
        return json.loads(path.read_text())[field]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: cannot be read, or has no field {field!r}") from error


def _rows(path: Path, digest: str) -> dict[str, Any]:
    """Returns task, split and the rows of a policy in a table of kinds: as it is, and cut."""
    if _read(path, "schema") not in MEASURED:
        raise ConfigError(f"{path}: is no table of benchmarks.kinds or train.locate.look")
    table, digests, config = _read(path, "rows"), _read(path, "policies"), _read(path, "config")
    kept = ("success", "low", "high", "contact", "median_error", "n")
    own = {
        _case(agent): {column: {name: cell[name] for name in kept if name in cell} for column, cell in row.items()}
        for agent, row in table.items()
        if digests.get(agent) == digest
    }
    if not own:
        raise ConfigError(f"{path}: has no row of this policy")
    conditions = {name: config[name] for name in ("task", "split", "tunnels", "episodes", "drives") if name in config}
    return {**conditions, **own}
