"""The README's numbers: where each stands, and where it is read again."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Read = Callable[[Any], float]
_WORDS = {"three": "3", "four": "4", "five": "5"}


@dataclass(frozen=True)
class Claim:
    """One number.

    Attributes:
        name: What it is.
        pattern: Where it stands in the README, line breaks as spaces; its one group is the number.
        job: Whose result has it.
        read: From the result to the number, in the README's unit.
        tolerance: How far it may be off, in that unit: the last digit that is printed, or what libraries may move.
        speed: Whether it depends on the machine, so that another value is no difference.
    """

    name: str
    pattern: str
    job: str
    read: Read
    tolerance: float
    speed: bool = False

    def stated(self, readme: str) -> float | None:
        """The number that the README has; `None` where it does not stand there any more."""
        found = re.search(self.pattern, " ".join(readme.split()))
        return None if found is None else float(_WORDS.get(found[1], found[1].replace(",", "")))


def _surveyed(poses: str, name: str, scale: float) -> Read:
    def read(content: Any) -> float:
        return scale * next(row[name] for row in content["rows"] if row["poses"] == poses)

    return read


def _planar(name: str, scale: float) -> Read:
    """Of the default lining, the mesh levelled along the track: the plane that the planar simulator is about."""

    def read(content: Any) -> float:
        title = "planar, pockets, levelled mesh"
        return scale * next(one["all"][name] for one in content["comparisons"] if one["title"] == title)

    return read


def _rate(n_envs: int, scale: float) -> Read:
    return lambda content: scale * next(row["median"] for row in content["speed"] if row["n_envs"] == n_envs)


def _success(agent: str, task: str) -> Claim:
    column = ("T0", "T1", "hidden", "T2", "T3", "T4", "T5").index(task)
    cells = r"[^|]*\|" * column

    def read(content: Any) -> float:
        return _board(content, agent, task)

    return Claim(f"{agent}, {task}, success %", rf"\| {agent} \|[^|]*\|{cells} ([\d.]+) \|", "leaderboard", read, 0.5)


_TASKS = {"T0": "Traverse", "T1": "StopAt", "T2": "Return", "T3": "Obstructed", "T4": "Faulted", "T5": "Relocalise"}


def _board(content: Any, agent: str, task: str) -> float:
    for row in content["scores"]:
        if row["agent"].replace("-", " ") == agent and row["task"] == f"Subterra/{_TASKS[task]}-v0":
            return 100.0 * row["success"]
    raise KeyError(f"{agent}, {task}")


def read_result(path: Path) -> Any:
    """What a job left; of several seeds, how many reached success in every one of their last 100 episodes."""
    if path.parent.name.startswith("seed-"):
        logs = [
            json.loads(log.read_text().splitlines()[-1]) for log in sorted(path.parents[1].glob("seed-*/log.jsonl"))
        ]
        return {"learnt": sum(line["success_mean_100"] >= 1.0 and line["coverage_mean_100"] >= 0.9 for line in logs)}
    return json.loads(path.read_text())


_351 = r"351 m simulated survey of a fresh seed, poses given \| "
_CONTROL = r"the same from odometry, IMU and prism control \| "
CLAIMS = (
    Claim("LiDAR against float64, largest error, mm", r"brute force, pockets on \| largest error ([\d.]+) mm", "speed",
          lambda c: 1e3 * c["exactness"]["max_error"], 0.5),
    Claim("whole step on a CPU with numba, M steps/s", r"with numba \| ([\d.]+)\D", "speed",
          _rate(1024, 1e-6), 0.0, True),
    Claim("seeds that learn 60 m on a CPU", r"PPO on 60 m, 2 CPU cores \|[^|]*, (\w+) of five seeds", "learning",
          lambda c: c["learnt"], 0.0),
    Claim("real metro, m", r"real metro, 217 rings \| ([\d,.]+) m", "metro", lambda c: c["bore"]["length"], 0.05),
    Claim("planar LiDAR against embree, median, mm", r"in the built mesh \| median ([\d.]+) mm", "rays",
          _planar("p50", 1e3), 0.01),
    Claim("the same, within 1 cm, %", r"median [\d.]+ mm, ([\d.]+) % within 1 cm", "rays",
          _planar("within_1cm", 100.0), 0.01),
    Claim("351 m, centreline, cm", _351 + r"centreline ([\d.]+) cm", "reconstruction",
          _surveyed("given", "lateral_rmse", 100.0), 0.1),
    Claim("351 m, width, cm", _351 + r".*?width ([\d.]+) cm", "reconstruction",
          _surveyed("given", "width_rmse", 100.0), 0.1),
    Claim("351 m, height, cm", _351 + r".*?height ([\d.]+) cm", "reconstruction",
          _surveyed("given", "height_rmse", 100.0), 0.1),
    Claim("351 m, held-out points, cm", _351 + r".*?held-out points ([\d.]+) cm", "reconstruction",
          _surveyed("given", "hold_mean", 100.0), 0.1),
    Claim("351 m, within 10 cm, %", _351 + r".*?([\d.]+) % within 10 cm", "reconstruction",
          _surveyed("given", "hold_within_10cm", 100.0), 0.02),
    Claim("351 m with control, centreline, cm", _CONTROL + r"centreline ([\d.]+) cm", "reconstruction",
          _surveyed("control", "lateral_rmse", 100.0), 0.1),
    Claim("351 m with control, held-out points, cm", _CONTROL + r".*?held-out points ([\d.]+) cm", "reconstruction",
          _surveyed("control", "hold_mean", 100.0), 0.1),
    Claim("fidelity of subterra-351, %", r"OS1 held out \| PASS, ([\d.]+) %", "fidelity", lambda c: c["global"], 0.1),
    Claim("its null tube, %", r"constant tube on the right axis ([\d.]+) %", "fidelity",
          lambda c: c["global_null"], 0.2),
    *(_success(agent, task) for agent in ("dead reckoning", "particle filter") for task in ("T0", "T1", "T4")),
)  # fmt: skip

# What the README says of a GPU, and the command that measures it there.
ON_A_GPU = (
    (r"([\d.]+) M steps/s on one H200", "python -m benchmarks.throughput --n 65536 --poses 200000 --out out/speed"),
    (r"([\d.]+) . JaxNav", "python -m benchmarks.throughput --n 65536 --peers jaxnav --out out/peers"),
    (r"([\d.]+) % slower in a tunnel ten times as long",
     "python -m benchmarks.throughput --n 65536 --lengths 351 3510 --out out/lengths"),
    (r"100 different tunnels at once, T1 \| ([\d.]+) M",
     "python -m benchmarks.throughput --task Subterra/StopAt-v0 --tunnel procedural:train:0-99 --n 65536"),
    (r"all five after ([\d.]+) s",
     "python -m train.navigate --task Subterra/Traverse-v0 --seeds 0 1 2 3 4 --out out/five"),
)  # fmt: skip
