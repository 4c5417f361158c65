# ruff: noqa: RUF001 (the texts repeat the documents' characters)
"""The tables of results as claims: where each number stands, how it is measured and how far it may be off.

A claim names a row by part of its first cell and a number by the words around it. The tables are those of the README
and of `docs/results.md` below the heading `HEADING`; a row that is not there is looked up in their other tables and in
`docs/measurements.md`.
"""

import json
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

HEADING = "How good"
_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?|\b(?:three|four|five)\b")
_WORDS = {"three": 3.0, "four": 4.0, "five": 5.0}


@dataclass(frozen=True)
class Job:
    """Commands that measure numbers and leave one file.

    Attributes:
        name: Name on the command line.
        commands: Words after `python -m`; `{out}` is the job's folder, `{shared}` that of surveys not packaged.
        result: File below the job's folder that holds the numbers once the job is done.
        minutes: Duration on two idle cores, minutes.
        needs: Path that must exist, or empty.
    """

    name: str
    commands: tuple[str, ...]
    result: str
    minutes: float
    needs: str = ""


@dataclass(frozen=True)
class Claim:
    """One number.

    Attributes:
        row: Part of the row's first cell.
        text: Words of a later cell; their first number is the claim's.
        tolerance: Largest difference that counts as the same, in the number's unit.
        bound: `near`: both ways; `at most`, `at least`: a smaller or larger measurement is no difference.
        job: Job that measures it; empty for a number that is only listed.
        read: Reads the number from the job's result, in the README's unit.
        command: Command that measures a listed number, after `python -m`.
        measured: Machine and date of a listed number.
        column: Heading of the cell, in tables with a column for each task.
    """

    row: str
    text: str
    tolerance: float
    bound: Literal["near", "at most", "at least"] = "near"
    job: str = ""
    read: Callable[[Any], float] | None = None
    command: str = ""
    measured: str = ""
    column: str = ""

    def stated(self, rows: Sequence[dict[str, str]]) -> float | None:
        """Returns the number as the documents have it; `None` where it is not there."""
        for row in rows:
            key, *_ = row.values()
            cells = [row.get(self.column, "")] if self.column else list(row.values())[1:]
            if self.row in key and (cell := next((cell for cell in cells if self.text in cell), None)) is not None:
                number = _NUMBER.search(self.text or cell)
                return None if number is None else _value(number[0])
        return None

    def holds(self, stated: float, measured: float) -> bool:
        """Returns whether a measurement agrees with the documents."""
        difference = measured - stated
        too_large = difference > self.tolerance + 1e-9 and self.bound != "at least"
        too_small = -difference > self.tolerance + 1e-9 and self.bound != "at most"
        return not (too_large or too_small)


def read_tables(markdown: str, heading: str = "") -> list[dict[str, str]]:
    """Returns the rows of Markdown tables, each a cell by column heading, without emphasis.

    Args:
        markdown: Text of a page.
        heading: Part of the heading below which the tables stand; all tables if empty.
    """
    rows: list[dict[str, str]] = []
    columns: list[str] = []
    inside = not heading
    for line in markdown.splitlines():
        if heading and line.startswith("#"):
            inside = heading in line
        if not line.startswith("|"):
            columns = []
        elif inside:
            cells = [cell.strip().replace("**", "") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            if not columns:
                columns = cells
            elif not set(line) <= set("|-: "):
                rows.append(dict(zip(columns, cells, strict=False)))
    return rows


def unclaimed(row: dict[str, str]) -> str:
    """Returns the rest of a row's cells after the first without its claims, settings and code; no digit may be left."""
    key, *cells = row.values()
    rest = " | ".join(cells)
    texts = [claim.text for claim in CLAIMS if claim.row in key] + [text for part, text in SETTINGS if part in key]
    for text in sorted(texts, key=len, reverse=True):
        rest = rest.replace(text, "")
    return re.sub(r"`[^`]*`", "", rest)


def read_result(path: Path) -> Any:
    """Reads a job's result; of several seeds, counts those whose last 100 episodes all succeed and cover 90 %."""
    if path.parent.name.startswith("seed-"):
        logs = [
            json.loads(log.read_text().splitlines()[-1]) for log in sorted(path.parents[1].glob("seed-*/log.jsonl"))
        ]
        return {"learnt": sum(line["success_mean_100"] >= 1.0 and line["coverage_mean_100"] >= 0.9 for line in logs)}
    return json.loads(path.read_text())


def _value(number: str) -> float:
    return _WORDS[number] if number in _WORDS else float(number.replace(",", ""))


def _survey(poses: str, name: str, scale: float = 1.0) -> Callable[[Any], float]:
    """Reads a figure of `benchmarks.reconstruction`."""
    return lambda content: scale * abs(next(row[name] for row in content["rows"] if row["poses"] == poses))


def _rays(title: str, name: str, scale: float) -> Callable[[Any], float]:
    """Reads a figure of `benchmarks.rays`."""
    return lambda content: scale * next(one["all"][name] for one in content["comparisons"] if one["title"] == title)


def _clouds(name: str, worst: Callable[[Iterable[float]], float], scale: float) -> Callable[[Any], float]:
    """Reads the worst of a figure of `benchmarks.dirty`, where it is defined; a cloud that was refused has none."""
    return lambda content: scale * worst(abs(row[name]) for row in content["rows"] if not math.isnan(row[name]))


def _success(agent: str, task: str) -> Callable[[Any], float]:
    """Reads a success of `benchmarks.leaderboard`, %."""
    return lambda content: (
        100.0
        * next(
            row["success"] for row in content["scores"] if (row["agent"], row["task"]) == (agent, f"Subterra/{task}-v1")
        )
    )


_SURVEY_351 = (
    "scene.survey --truth metro --length 351 --seed 0 --sensors avia os1 --scan-every 10 --out {out}/survey",
    "scene.build {out}/survey/survey.bag --trajectory {out}/survey/groundtruth.tum --provenance simulated "
    "--name subterra-351 --out {out}/scene",
)
_FIDELITY = (
    "benchmarks.fidelity run --scene {out}/scene --recording {out}/survey/survey_os1.bag "
    "--trajectory {out}/survey/groundtruth_os1.tum --truth {out}/survey --out {out}/report"
)
_LEARN = "train.navigate --task Subterra/TraverseShort-v1 --preset cpu --seeds 0 1 2 3 4 --overwrite --out {out}"
_METRO, _DIRTY = "{shared}/data/metro_asbuilt", "{shared}/data/dirty_clouds"
JOBS = {
    job.name: job
    for job in (
        Job("speed", ("benchmarks.throughput --n 1 1024 --peers none --poses 200000 --out {out}",),
            "throughput.json", 2.0),
        Job("learning", (_LEARN,), "seed-4/evaluation.json", 3.0),
        Job("metro", (f"scene.build {_METRO} --out {{out}}/scene",), "scene/manifest.json", 2.0, _METRO),
        Job("dirty", (f"benchmarks.dirty {_DIRTY} --out {{out}}",), "dirty.json", 3.0, _DIRTY),
        Job("rays", (*_SURVEY_351, "benchmarks.rays --scene {out}/scene --out {out}/rays.json"), "rays.json", 8.0),
        Job("reconstruction", ("benchmarks.reconstruction --seeds 203 --length 351 --truth metro --out {out}",),
            "figures-metro-351.json", 12.0),
        Job("fidelity", (*_SURVEY_351, _FIDELITY), "report/report.json", 15.0),
        Job("leaderboard", ("benchmarks.leaderboard --tunnels subterra-351 --out {out}",), "leaderboard.json", 180.0),
    )
}  # fmt: skip

_CPU, _H200 = "2 CPU cores, 2026-11-21", "one H200, 2026-11-21"
_CPU_LATER, _CPU_BOARD = "2 CPU cores, 2026-11-26", "2 CPU cores, 2026-11-24"
_H200_BOARD = "one H200, 2026-11-25"
_MANY_CORES = "32 CPU cores, 2026-11-26"
_UNIVERSAL = (
    "scene.build build/survey-universal/survey.bag --trajectory build/survey-universal/groundtruth.tum "
    "--provenance simulated --name subterra-universal --out build/subterra-universal"
)
_H200_TODAY, _H100 = "one H200, 2026-11-22", "one H100 80GB, 2026-11-25"
_OUTSIDE, _OUTSIDE_H200 = "measured from outside, 2026-11-22", "measured from outside on one H200, 2026-11-22"
_JUDGED, _CONTROLS = "benchmarks.fidelity run --out out/fidelity", "benchmarks.fidelity controls --bold-only"
_PEERS = "benchmarks.throughput --n 65536 --peers jaxnav --seconds 8 --poses 62500 --out out/peers"
_LENGTHS = "benchmarks.throughput --n 65536 --lengths 351 3510 --out out/lengths"
_T1_STEP = "benchmarks.throughput --task Subterra/StopAt-v1 --n 65536 --out out/stop"
_MANY = "benchmarks.throughput --task Subterra/StopAt-v1 --tunnel open:train:0-99 --n 65536"
_OPEN_STEP = "T1 of version 1 in 1,020 tunnels"
_OPEN_MANY = (
    "benchmarks.throughput --task Subterra/StopAt-v1 --n 65536 --copies 17 --tunnel open:straight:train:0-9,"
    "open:cast:train:0-9,open:sprayed:train:0-9,open:masonry:train:0-9,open:universal:test-unseen:0-9,"
    "open:rock:test-unseen:0-9"
)
_SPIN = (
    "train.navigate --task Subterra/StopAt-v1 --memory gru --teacher oracle --sensor spin16x64 --preset gpu "
    "--tunnel open:val:0-11 --n-envs 65536 --unroll 64 --hidden 128 --minibatches 8 --half --sums any "
    "--out out/spin"
)
_STEP_ON_CPU = "benchmarks.throughput --n 1024 --peers none"
_FIVE = "train.navigate --task Subterra/Traverse-v1 --preset gpu --seeds 0 1 2 3 4 --out out/five"
_FAMILY = (
    "train.navigate --task Subterra/StopAt-v1 --memory gru --teacher oracle --tunnel open:train:0-255 "
    "--steps 150000000 --out out/family"
)
_RELEASED = "benchmarks.leaderboard --agents released-policy --tasks"
_SMOOTH_METRO = f"{_RELEASED} StopAt --tunnels metro-asbuilt --linings smooth --episodes 100 --out out/smooth"
_SMOOTH_RETURN = f"{_RELEASED} Return --linings smooth --out out/smooth"
_AT_THE_METRO = f"{_RELEASED} Obstructed Faulted Relocalise --tunnels metro-asbuilt --out out/metro"
_UNSEEN = f"{_RELEASED} Obstructed Faulted --tunnels open:val:0-63 --out out/unseen"
_SHORT = (
    "train.navigate --task Subterra/StopAtShort-v1 --memory gru --teacher oracle --preset cpu "
    "--evaluation-episodes 500 --out out/short"
)
_WALK, _B2 = "train.walk --preset gpu --out out/walk", "benchmarks.b2 --robots 8192"
_TRAVERSE = "benchmarks.b2_traverse --robots 100 --agent B2Traverse-v1"
_FOUR = "train.navigate --task Subterra/Traverse-v1 --preset gpu --parts 4 --out out/four"
_BOARD = "benchmarks.openboard --tasks StopAt --splits test-unseen --out out/openboard --agents"
_GYM = (
    'timeit -n 2000 -r 5 -s \'import gymnasium; env = gymnasium.make("subterra_jax:Subterra/Traverse-v1"); '
    "env.reset(); action = env.action_space.low; env.step(action)' 'env.step(action)'"
)

_GIVEN, _CONTROL = "simulated survey, poses given", "odometry, IMU and prism control"
_PLANAR, _TILTED = "planar, pockets, levelled mesh", "3-D, pockets"
_CLOUDS = "nine simulated clouds"
_TURNED = "351 m of rings that turn"
_SUITE, _STEP = "fidelity suite", "whole environment step"
_LEGS, _THROUGH = "Unitree B2 on sleepers", "100 of them through"
_SPREAD, _FIVE_SEEDS, _ONE_POLICY = "robots spread along the tunnel", "five seeds of PPO on 351 m", "family of tunnels"
_OBSTACLES, _PLACE, _OPEN = "T3 among boxes", "T5: report the place", "T1 of the open world"
CLAIMS = (
    # row, text, tolerance, bound, and where the number comes from
    Claim(_GIVEN, "centreline 0.3 cm", 0.1, job="reconstruction", read=_survey("given", "lateral_rmse", 100.0)),
    Claim(_GIVEN, "width 0.6 cm", 0.1, job="reconstruction", read=_survey("given", "width_rmse", 100.0)),
    Claim(_GIVEN, "height 0.2 cm", 0.1, job="reconstruction", read=_survey("given", "height_rmse", 100.0)),
    Claim(_GIVEN, "1.1 cm", 0.1, job="reconstruction", read=_survey("given", "hold_mean", 100.0)),
    Claim(_GIVEN, "99.99 %", 0.02, job="reconstruction", read=_survey("given", "hold_within_10cm", 100.0)),
    Claim(_GIVEN, "2 min", 3.0, "at most", job="reconstruction", read=_survey("given", "seconds", 1 / 60)),
    Claim(_CONTROL, "centreline 1.8 cm", 0.1, job="reconstruction", read=_survey("control", "lateral_rmse", 100.0)),
    Claim(_CONTROL, "0.02 %", 0.01, "at most", job="reconstruction", read=_survey("control", "length_error")),
    Claim(_CONTROL, "1.4 cm", 0.1, job="reconstruction", read=_survey("control", "hold_mean", 100.0)),
    Claim(_CONTROL, "6.5 min", 8.5, "at most", job="reconstruction", read=_survey("control", "seconds", 1 / 60)),
    Claim(_TURNED, "1,692 of 1,726", 0.0, command=_UNIVERSAL, measured="2 CPU cores, 2026-11-25"),
    Claim(_TURNED, "3.3 mm", 0.3, "at most", command=_UNIVERSAL, measured="2 CPU cores, 2026-11-25"),
    Claim(_TURNED, "230 of 230", 0.0, command=_UNIVERSAL, measured="2 CPU cores, 2026-11-25"),
    Claim(_TURNED, "16 mm", 2.0, "at most", command=_UNIVERSAL, measured="2 CPU cores, 2026-11-25"),
    Claim(_SUITE, "98.0 %", 0.1, job="fidelity", read=lambda c: c["global"]),
    Claim(_SUITE, "69.3 %", 0.2, job="fidelity", read=lambda c: c["global_null"]),
    Claim(_SUITE, "18 categories", 0.0, job="fidelity", read=lambda c: len(c["categories"])),
    Claim(_SUITE, "8.6 min", 10.0, "at most", command=_JUDGED, measured=_CPU_LATER),
    Claim(_SUITE, "5.1 GiB", 0.2, "at most", command=_JUDGED, measured=_CPU_LATER),
    Claim("its controls", "39 of 39", 0.0, command=_CONTROLS, measured=_MANY_CORES),
    Claim("its controls", "7 of 7", 0.0, command=_CONTROLS, measured=_MANY_CORES),
    Claim("its controls", "3.1 points", 0.1, "at most", command=_CONTROLS, measured=_MANY_CORES),
    Claim("real metro", "1,283.7 m", 0.05, job="metro", read=lambda c: c["bore"]["length"]),
    Claim("real metro", "0.3 mm", 0.1, "at most", command="pytest tests/scene/test_rings.py", measured=_CPU),
    Claim(_CLOUDS, "0.5 cm", 0.1, "at most", job="dirty", read=_clouds("wall_mean", max, 100.0)),
    Claim(_CLOUDS, "99.7 %", 0.1, "at least", job="dirty", read=_clouds("wall_near", min, 100.0)),
    Claim(_CLOUDS, "4.6 cm", 0.3, "at most", job="dirty", read=_clouds("width", max, 100.0)),
    Claim(_CLOUDS, "up to 10 cm", 1.0, "at most", job="dirty", read=_clouds("floor_worst", max, 100.0)),
    Claim("float64 brute force", "0.8 mm", 0.2, "at most", job="speed",
          read=lambda c: 1e3 * c["exactness"]["max_error"]),
    Claim(_STEP, "215 M", 15.0, "at least", command=_PEERS, measured=_H200),
    Claim(_STEP, "21 × JaxNav", 3.0, "at least", command=_PEERS, measured=_H200),
    Claim(_STEP, "3 % slower", 1.0, "at most", command=_LENGTHS, measured=_H200),
    Claim(_SPREAD, "210 M", 15.0, "at least", command=f"{_T1_STEP} (and the robots spread)", measured=_OUTSIDE_H200),
    Claim(_SPREAD, "0.05 %", 0.02, "at most", command=f"{_T1_STEP} (and the robots spread)", measured=_H200_TODAY),
    Claim(_SPREAD, "198 M", 15.0, "at least", command=f"{_T1_STEP} (and the robots spread)", measured=_H200_TODAY),
    Claim(_SPREAD, "233 M", 15.0, "at least", command=_T1_STEP, measured=_OUTSIDE_H200),
    Claim("with a spinning LiDAR", "3.3 M", 0.3, "at least", command=_SPIN, measured=_H100),
    Claim("100 different tunnels", "202 M", 15.0, "at least", command=_MANY, measured=_H200),
    Claim(_OPEN_STEP, "164 M", 12.0, "at least", command=_OPEN_MANY, measured="one H200, 2026-11-26"),
    Claim(_OPEN_STEP, "226 M", 15.0, "at least", command=f"{_OPEN_MANY} (and N)", measured="one H200, 2026-11-26"),
    Claim(_OPEN_STEP, "145 M", 12.0, "at least", command=_OPEN_MANY, measured="one H100, 2026-11-25"),
    Claim("planar LiDAR against embree", "0.09 mm", 0.01, job="rays", read=_rays(_PLANAR, "p50", 1e3)),
    Claim("planar LiDAR against embree", "99.95 %", 0.01, job="rays", read=_rays(_PLANAR, "within_1cm", 100.0)),
    Claim("planar LiDAR against embree", "2 µm", 1.0, "at most", job="rays", read=_rays(_TILTED, "p50", 1e6)),
    Claim("with numba", "1.05–1.11 M", 0.7, "at least", job="speed", read=lambda c: next(
        1e-6 * row["median"] for row in c["speed"] if row["n_envs"] == 1024)),
    Claim("with numba", "0.41 M", 0.25, "at least", command=f"{_STEP_ON_CPU} (numba not installed)", measured=_CPU),
    Claim("one Gymnasium environment", "26,000 steps/s", 13_000.0, "at least", command=_GYM, measured=_CPU),
    Claim("one Gymnasium environment", "10,300–16,800", 5_000.0, "at least", command=_GYM, measured=_CPU),
    Claim(_FIVE_SEEDS, "10.8 s", 1.0, "at most", command=_FIVE, measured=_H200),
    Claim(_FIVE_SEEDS, "5.3 s", 1.0, "at most", command=_FIVE, measured=_H200),
    Claim(_FIVE_SEEDS, "14.4 s", 2.0, "at most", command=_FIVE, measured=_OUTSIDE_H200),
    Claim(_FIVE_SEEDS, "6.0 s", 1.0, "at most", command=_FIVE, measured=_OUTSIDE_H200),
    Claim(_ONE_POLICY, "98.2 % on its test split", 1.0, command=_FAMILY, measured=_H200),
    Claim(_ONE_POLICY, "100 % in `subterra-351`", 0.5, command=_FAMILY, measured=_H200),
    Claim(_ONE_POLICY, "100 % in `metro-asbuilt`", 0.5, command=_FAMILY, measured=_H200),
    Claim(_ONE_POLICY, "122 s", 30.0, "at most", command=_FAMILY, measured=_H200),
    Claim(_ONE_POLICY, "28 %", 9.0, command=_SMOOTH_METRO, measured=_OUTSIDE),
    Claim("T2: come back", "100 %", 0.5, command=f"{_RELEASED} Return --out out/back", measured=_H200),
    Claim("T2: come back", "98.2 %", 1.2, command=_SMOOTH_RETURN, measured=_OUTSIDE),
    Claim(_OBSTACLES, "T3 99.8 %", 0.5, command=f"{_RELEASED} Obstructed --out out/boxes", measured=_H200),
    Claim(_OBSTACLES, "T4 96.6 %", 1.6, command=f"{_RELEASED} Faulted --out out/faults", measured=_H200),
    Claim(_OBSTACLES, "T3 97.6 %", 1.4, command=_UNSEEN, measured=_H200),
    Claim(_OBSTACLES, "T4 81.8 %", 3.4, command=_UNSEEN, measured=_H200),
    Claim(_OBSTACLES, "T3 99.4 %", 0.7, command=_AT_THE_METRO, measured=_H200),
    Claim(_OBSTACLES, "T4 87.8 %", 2.9, command=_AT_THE_METRO, measured=_H200),
    Claim(_PLACE, "100 %", 0.5, command=f"{_RELEASED} Relocalise --out out/place", measured=_H200),
    Claim(_PLACE, "44.8 % in `metro-asbuilt`", 4.4, command=_AT_THE_METRO, measured=_H200),
    Claim("learnt from a teacher on a CPU", "99.4 %", 1.0, command=_SHORT, measured=_CPU),
    Claim("learnt from a teacher on a CPU", "6 CPU-minutes", 2.0, "at most", command=_SHORT, measured=_CPU),
    Claim("learnt from a teacher on a CPU", "33 min", 33.0, "at most", command=_SHORT, measured=_CPU),
    Claim(_LEGS, "falls 0.4 %", 0.6, "at most", command=_WALK, measured=_H200),
    Claim(_LEGS, "0.04 m/s", 0.01, "at most", command=_WALK, measured=_H200),
    Claim(_LEGS, "0.02 rad/s", 0.01, "at most", command=_WALK, measured=_H200),
    Claim(_OPEN, "71 %", 5.0, command=f"{_BOARD} locate-transformer", measured=_CPU_BOARD),
    Claim(_OPEN, "86 %", 4.0, command=f"{_BOARD} locate-spin --sensor spin16x64", measured=_CPU_BOARD),
    Claim(_OPEN, "48 %", 5.0, command=f"{_BOARD} fused ring-count ring-filter scan-matching", measured=_H200_BOARD),
    Claim(_OPEN, "99 %", 1.0, command=f"{_BOARD} ceiling", measured="one H200, 2026-11-26"),
    Claim(_LEGS, "190 s", 30.0, "at most", command=_WALK, measured=_H200),
    Claim(_LEGS, "5.5 M physics steps/s", 0.3, "at least", command=_B2, measured=_H200),
    Claim(_THROUGH, "100 arrive", 1.0, command=_TRAVERSE, measured=_H200),
    Claim(_THROUGH, "100 of 100 in MuJoCo", 1.0, command=f"{_TRAVERSE} --engine mujoco", measured=_CPU),
    Claim("four H200s", "75.8 M", 4.0, "at least", command=_FOUR, measured="four H200s, 2026-11-21"),
    Claim("four H200s", "97 %", 3.0, "at least", command=_FOUR, measured="four H200s, 2026-11-21"),
    Claim("PPO on 60 m", "115 k steps", 16.0, "at most", command=_LEARN.format(out="out/t0"), measured=_CPU),
    Claim("PPO on 60 m", "6 s", 4.0, "at most", command=_LEARN.format(out="out/t0"), measured=_CPU),
    Claim("PPO on 60 m", "five of five seeds", 0.0, job="learning", read=lambda c: c["learnt"]),
    # The table of agents.
    *(
        Claim(row, "", 0.5, job="leaderboard", read=_success(agent, task), column=column)
        for row, agent in (("dead reckoning", "dead-reckoning"), ("particle filter", "particle-filter"))
        for column, task in (("T0", "Traverse"), ("T1", "StopAt"), ("T4", "Faulted"))
    ),
)  # fmt: skip

# Numbers in those rows that are conditions of a measurement, not results.
SETTINGS = (
    (_GIVEN, "within 10 cm"), (_GIVEN, "2 cores"), (_SUITE, "2 idle cores"), ("float64 brute force", "3.2 M rays"),
    (_CLOUDS, "within 10 cm"), (_STEP, "H200"), (_STEP, "N = 65,536"), ("planar LiDAR against embree", "within 1 cm"),
    (_FIVE_SEEDS, "90 % coverage and 100 % success of the last 100 episodes"),
    ("learnt from a teacher on a CPU", "500 listed episodes"), (_LEGS, "H200"), (_LEGS, "8,192 robots"),
    ("PPO on 60 m", "90 % coverage and 100 % success"), (_OPEN_STEP, "60 different tunnels, 17 copies of each"),
    (_OPEN_STEP, "one H100"), ("float64 brute force", "320,000 rays in 60 tunnels, on an H200"),
    (_OPEN, "within 1 m"), (_OPEN, "300 episodes"),
)  # fmt: skip
