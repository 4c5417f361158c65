"""Runs programs on recordings, each in a process of its own, and keeps poses and facts of every run."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.command import BenchmarkError
from benchmarks.results import environment_facts, write_file
from benchmarks.slam.programs import PROGRAMS, WHEELS, find_program
from benchmarks.slam.reading import (
    CALIBRATION,
    ODOMETRY,
    TRUTH,
    TRUTH_FILE,
    check_recording,
    count_messages,
    recordings_in,
)
from subterra_jax.host.files import replace_file, require_folder

_ALONE = "import sys; from benchmarks.slam.programs import main; sys.exit(main(sys.argv[1:]))"
_SAYS = '{"poses"'  # beginning of the line in which the process reports


@dataclass(frozen=True)
class RunConfig:
    """Settings of a run."""

    # `kiss-icp`, `genz-icp`, `kiss-icp-planar`; one of `evalio-` and `kiss`, `genz`, `mad`, `ct`, `loam`, `liosam`,
    # `dlio`, `form`, or `rko-lio`, `ring-filter`, `particle-filter`, on recordings of the arena; or `wheel-odometry`,
    # which copies the robot's own odometry.
    library: str
    recordings: Path  # Set of recordings, or its `recordings/`.
    out: Path  # Folder for poses, `NAME.tum`, and facts, `NAME.json`; what is there is kept.
    limit: float = 3600.0  # Time after which a program counts as failed on a recording, s.


@dataclass(frozen=True)
class Case:
    """One program on one recording."""

    program: str  # Name of the program
    recording: Path  # Folder of the recording
    place: Path  # Folder of the poses and facts

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def facts(self) -> Path:
        """File of what is known of the run."""
        return self.place / f"{self.name}.json"

    @property
    def poses(self) -> Path:
        """File of the estimated poses; missing where the program failed."""
        return self.place / f"{self.name}.tum"

    @property
    def truth(self) -> Path:
        """File of the true poses."""
        return self.recording.parent.parent / TRUTH / self.name / TRUTH_FILE


def run_case(case: Case, limit: float) -> dict[str, Any]:
    """Runs a case unless its facts are there, for `limit` s at most.

    Returns:
        `seconds` that the program took, `share` of the recording's duration, `poses`, or `failed` with the reason;
        `version`, `date` and `machine`.
    """
    if case.facts.is_file():
        return json.loads(case.facts.read_text())
    case.place.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {}
    if case.program == WHEELS:
        with replace_file(case.poses) as fresh:
            shutil.copyfile(case.recording / "recording" / ODOMETRY, fresh)
    else:
        result = _run_alone(case, limit)
    facts = environment_facts()
    result |= {"version": find_program(case.program), "date": facts["date"]}
    result["machine"] = f"{facts['cpu_cores']} cores, {facts['processor']}"
    write_file(case.facts, (json.dumps(result) + "\n").encode())
    return result


def _run_alone(case: Case, limit: float) -> dict[str, Any]:
    """Runs a program in a process of its own: one that crashes takes no other with it."""
    words = [sys.executable, "-c", _ALONE, case.program]
    paths = [str(case.recording.resolve()), str(case.poses.resolve())]
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    try:
        done = subprocess.run([*words, *paths], capture_output=True, text=True, timeout=limit, env=environment)
    except subprocess.TimeoutExpired:
        return {"failed": f"did not finish within {limit:g} s"}
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or [f"ended with status {done.returncode}"]
        return {"failed": last[0] if done.returncode > 0 else f"crashed with signal {-done.returncode}: {last[0]}"}
    said = [line for line in done.stdout.splitlines() if line.startswith(_SAYS)]  # libraries print too
    return json.loads(said[-1])


def describe(result: dict[str, Any]) -> str:
    """Returns a line about a run."""
    if "failed" in result:
        return f"failed: {result['failed']}"
    if "poses" not in result:
        return "copied"
    return f"{result['poses']} poses in {result['seconds']:.0f} s, {100.0 * result['share']:.0f} % of real time"


def run_all(config: RunConfig) -> Iterator[tuple[str, str]]:
    """Runs a program on every recording that it can read; yields each name and a line about its result.

    Raises:
        BenchmarkError: The program is unknown or not installed, a bag is missing or damaged, or no recording has what
            it reads.
    """
    find_program(config.library)
    require_folder(config.out)
    folders, topic = recordings_in(config.recordings), ""
    if config.library != WHEELS:
        topic = PROGRAMS[config.library].topic
        if not topic:
            _check_arena(config, folders)
    some = [folder for folder in folders if not topic or topic in count_messages(folder)]
    if not some:
        raise BenchmarkError(f"{config.recordings}: no recording has what {config.library} reads")
    for folder in folders:
        case = Case(config.library, folder, config.out)
        if folder not in some:
            yield folder.name, f"has no {topic}"
        elif case.facts.is_file():
            yield folder.name, "there already"
        else:
            yield folder.name, describe(run_case(case, config.limit))


def _check_arena(config: RunConfig, folders: list[Path]) -> None:
    """Checks that recordings are those of the arena, and whole: a damaged bag is no failure of a program."""
    if not any((folder / CALIBRATION).is_file() for folder in folders):
        raise BenchmarkError(
            f"{config.recordings}: holds no {CALIBRATION}, which {config.library} needs "
            "(`python -m benchmarks.slam arena` makes such recordings)"
        )
    for folder in folders:
        check_recording(folder)
