"""The arena's board: every program on every recording of some sets, scored, as a table and as the dial's figure."""

import csv
import io
import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.command import BenchmarkError, require_least
from benchmarks.results import environment_facts, write_file
from benchmarks.slam.arena.bound import find_floor
from benchmarks.slam.arena.gate import find_gate
from benchmarks.slam.arena.sets import redraw
from benchmarks.slam.inertial import PROGRAMS, find_program, run_program
from benchmarks.slam.recordings import TRUTH, check_recording, recordings_in
from benchmarks.slam.run import WHEELS
from benchmarks.slam.score import TRUTH_FILE, score_files
from subterra_jax.host.files import replace_file

SCHEMA = "subterra.arena-board/1"
LEAST_COVERED = 0.9  # share of a recording below which a program counts as failed on it
FLOOR = "floor"  # stands for a program in rows of a file of runs that hold a recording's bound and gate
_KEYS = ("set", "recording", "program")
_TEXTS = (*_KEYS, "version", "date", "machine", "failed")
_NUMBERS = ("distance", "covered", "drift", "along_final", "along_rms", "across_rms", "up_rms", "reach", "seconds",
            "share", "gate")  # fmt: skip
_DIGITS = 6  # of each number in a file of runs


@dataclass(frozen=True)
class BoardConfig:
    """Settings of a board.

    Attributes:
        sets: Sets of the arena with their truth, one for each seed; none where `runs` alone make the board.
        out: Folder for poses, `board.json`, `board.md`, `board.png` and `records.json`.
        programs: Programs to run; by default all, the odometer included.
        jobs: Programs run at a time.
        limit: Time after which a program counts as failed on a recording, s.
        run: Run what is missing; otherwise only poses that are in `out` already are scored, and no bag is needed.
        runs: CSV file of runs: they stand on the board too, and those of `sets` are added to it or replace theirs.
    """

    out: Path
    sets: tuple[Path, ...] = ()
    programs: tuple[str, ...] = (WHEELS, *PROGRAMS)
    jobs: int = 1
    limit: float = 1800.0
    run: bool = True
    runs: Path | None = None


@dataclass(frozen=True)
class Case:
    """One program on one recording of one set."""

    program: str
    folder: Path
    place: Path  # Folder of its poses and facts

    @property
    def facts(self) -> Path:
        """File of what is known of the run."""
        return self.place / f"{self.folder.name}.json"

    @property
    def truth(self) -> Path:
        """File of the true poses."""
        return self.folder.parent.parent / TRUTH / self.folder.name / TRUTH_FILE


def plan_board(config: BoardConfig) -> list[Case]:
    """Returns the cases of a board.

    Raises:
        BenchmarkError: A program is unknown or not installed, a set holds no recordings or no truth, a bag that is
            to be run on is damaged, two sets have one name, or there is nothing to score.
    """
    _check_board(config)
    cases = []
    for folder in config.sets:
        for name, bag in recordings_in(folder):
            place = config.out / "poses" / folder.name
            cases += [Case(program, bag.parent, place / program) for program in config.programs]
            if not cases[-1].truth.is_file():
                raise BenchmarkError(f"{folder}: holds no truth of {name}")
    for folder in {one.folder for one in cases if config.run and not one.facts.is_file()}:
        check_recording(folder)  # a damaged bag is no failure of a program
    cases = [one for one in cases if config.run or one.program == WHEELS or one.facts.is_file()]
    if config.sets and all(one.program == WHEELS for one in cases) and any(name != WHEELS for name in config.programs):
        raise BenchmarkError(f"{config.out}: holds no poses of {', '.join(config.programs)} to score")
    return cases


def _check_board(config: BoardConfig) -> None:
    """Refuses settings that make no board, before a recording is opened."""
    require_least(config, jobs=1)
    if not config.programs or not (config.sets or config.runs):
        raise BenchmarkError("sets and programs must name at least one")
    if not config.sets and config.runs is not None and not config.runs.is_file():
        raise BenchmarkError(f"{config.runs}: no such file, and no sets to run on")
    if len({folder.name for folder in config.sets}) < len(config.sets):
        raise BenchmarkError("sets must differ in the last part of their names")
    for name in config.programs:
        if name not in (*PROGRAMS, WHEELS):
            raise BenchmarkError(f"no program {name!r}; there are {', '.join([WHEELS, *PROGRAMS])}")
        if name != WHEELS and config.run:
            find_program(name)


def make_board(config: BoardConfig) -> Iterator[tuple[str, str]]:
    """Runs and scores what is missing; yields each case and its result; writes `board.json` at the end.

    Raises:
        BenchmarkError: See `plan_board`.
    """
    cases = plan_board(config)
    kept = read_runs(config.runs) if config.runs is not None and config.runs.is_file() else []
    # The slowest programs begin first, so that the last case does not wait for one of them.
    order = sorted(cases, key=lambda one: one.program not in ("evalio-form", "evalio-genz", "evalio-ct"))
    with ThreadPoolExecutor(config.jobs) as pool:
        futures = {pool.submit(_run, one, config.limit): one for one in order}
        for future in as_completed(futures):
            one = futures[future]
            yield f"{one.place.parent.name} {one.folder.name} {one.program}", _describe_result(future.result())
    rows = [_labels(one) | read_case(one) for one in cases]
    floors = []
    for floor in _find_floors(config):
        floors.append(floor)
        yield f"{floor['set']} {floor['recording']} floor", f"{floor['drift']:.4f} m per 100 m"
    if config.runs is not None:
        every = merge_runs(kept, [*rows, *({"program": FLOOR} | one for one in floors)])
        write_file(config.runs, runs_as_csv(every).encode())
        rows, floors = [one for one in every if one["program"] != FLOOR], [o for o in every if o["program"] == FLOOR]
    content = {"schema": SCHEMA, **environment_facts(), "versions": _versions(config), "rows": rows, "floors": floors}
    write_file(config.out / "board.json", (json.dumps(content, indent=1, default=str) + "\n").encode())


def _run(case: Case, limit: float) -> dict[str, Any]:
    """Runs a case unless its facts are there; returns them."""
    facts, target = case.facts, case.place / f"{case.folder.name}.tum"
    if facts.is_file():
        return json.loads(facts.read_text())
    case.place.mkdir(parents=True, exist_ok=True)
    if case.program == WHEELS:
        with replace_file(target) as fresh:
            fresh.write_bytes((case.folder / "recording" / "odometry.tum").read_bytes())
        result: dict[str, Any] = {}
    else:
        result = run_program(case.program, case.folder, target, limit)
        result["version"] = find_program(case.program)
    facts_here = environment_facts()
    result |= {"date": facts_here["date"], "machine": f"{facts_here['cpu_cores']} cores, {facts_here['processor']}"}
    write_file(facts, (json.dumps(result) + "\n").encode())
    return result


def _describe_result(result: dict[str, Any]) -> str:
    return f"failed: {result['failed']}" if "failed" in result else f"{result.get('seconds', 0.0):.0f} s"


def _labels(case: Case) -> dict[str, Any]:
    return {"set": case.place.parent.name, "recording": case.folder.name, "program": case.program}


def read_case(case: Case) -> dict[str, Any]:
    """Returns the facts and the score of a case that was run."""
    facts = _run(case, 0.0)
    target = case.place / f"{case.folder.name}.tum"
    if "failed" in facts:
        return facts
    try:
        score, _ = score_files(target, case.truth)
    except BenchmarkError as error:
        return facts | {"failed": str(error)}
    if score.covered < LEAST_COVERED:
        facts = facts | {"failed": f"gives poses over {100.0 * score.covered:.0f} % of the recording only"}
    kept = ("distance", "covered", "drift", "along_final", "across_rms", "up_rms", "reach")
    return facts | {name: getattr(score, name) for name in kept} | {"along_rms": score.along_rms}


def _find_floors(config: BoardConfig) -> Iterator[dict[str, Any]]:
    """Yields floor and gate of each recording of the sets, in order."""
    cases = [(folder, name, config.out / "floors" / folder.name / f"{name}.json")
             for folder in config.sets for name, _ in recordings_in(folder)]  # fmt: skip
    if config.jobs == 1 or all(kept.is_file() for *_, kept in cases):
        yield from (_floor(*one) for one in cases)
        return
    with ProcessPoolExecutor(config.jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(_floor, *zip(*cases, strict=True))


def _floor(folder: Path, name: str, kept: Path) -> dict[str, Any]:
    """Returns floor and gate of a recording, drawn again from the settings beside its truth unless they are kept."""
    if not kept.is_file():
        scene = redraw(folder, name)
        facts = find_floor(scene)._asdict() | {"gate": find_gate(scene)}
        facts |= {"walls": scene.course.walls, "sensor": scene.course.sensor}
        write_file(kept, (json.dumps(facts) + "\n").encode())
    return {"set": folder.name, "recording": name, **json.loads(kept.read_text())}


def _versions(config: BoardConfig) -> dict[str, str]:
    return {name: find_program(name) for name in config.programs if name != WHEELS}


def merge_runs(kept: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns runs of both lists, by set, recording and program; of two of one kind the new one."""
    rows = {tuple(row[key] for key in _KEYS): row for row in [*kept, *new]}
    return [rows[key] for key in sorted(rows)]


def runs_as_csv(rows: list[dict[str, Any]]) -> str:
    """Returns a file of runs: a row a run, six digits a number, empty where there is none."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_TEXTS, *_NUMBERS])
    for row in rows:
        numbers = [row.get(name) for name in _NUMBERS]
        shown = ["" if value is None else f"{value:.{_DIGITS}g}" for value in numbers]
        writer.writerow([*(row.get(name, "") for name in _TEXTS), *shown])
    return text.getvalue()


def read_runs(path: Path) -> list[dict[str, Any]]:
    """Reads a file of runs.

    Raises:
        BenchmarkError: It is no such file, or a number in it is none.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != (*_TEXTS, *_NUMBERS):
                raise BenchmarkError(f"{path}: not a file of runs, for its columns are others")
            return [_run_of(row) for row in reader]
    except (OSError, ValueError, TypeError) as error:
        raise BenchmarkError(f"{path}: not a file of runs ({error})") from error


def _run_of(row: dict[str, str]) -> dict[str, Any]:
    """Returns a run without what is empty; only a reach may be `None`: the error never exceeded a metre."""
    texts = {name: row[name] for name in _TEXTS if row[name] or name in _KEYS}
    numbers = {name: float(row[name]) for name in _NUMBERS if row[name]}
    return texts | numbers | ({} if "failed" in texts or "reach" in numbers else {"reach": None})
