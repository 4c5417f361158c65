"""What has to be run before numbers can be read."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.reproduce.errors import ReproduceError


@dataclass(frozen=True)
class Job:
    """Commands that leave one file.

    Attributes:
        name: Of the job.
        commands: Words after `python -m`; `{out}` is the job's folder, `{shared}` that of the surveys not packaged.
        result: File below the job's folder that says the job is done, and is read.
        about: How long it takes on two idle cores, minutes.
        needs: Path that must be there, or empty.
    """

    name: str
    commands: tuple[str, ...]
    result: str
    about: float
    needs: str = ""


_SURVEY = (
    "scene.survey --truth metro --length 351 --seed 0 --sensors avia os1 --scan-every 10 --out {out}/survey",
    "scene.build {out}/survey/survey.bag --trajectory {out}/survey/groundtruth.tum --provenance simulated "
    "--name subterra-351 --out {out}/scene",
)
JOBS = {
    job.name: job
    for job in (
        Job(
            "speed",
            ("benchmarks.throughput --n 1 1024 --peers none --poses 200000 --out {out}",),
            "throughput.json",
            2.0,
        ),
        Job(
            "learning",
            ("train.navigate --task Subterra/TraverseShort-v0 --preset cpu --seeds 0 1 2 3 4 --overwrite --out {out}",),
            "seed-4/evaluation.json",
            3.0,
        ),
        Job(
            "metro",
            ("scene.build {shared}/data/metro_asbuilt --out {out}/scene",),
            "scene/manifest.json",
            2.0,
            "{shared}/data/metro_asbuilt",
        ),
        Job("rays", (*_SURVEY, "benchmarks.rays --scene {out}/scene --out {out}/rays.json"), "rays.json", 8.0),
        Job(
            "reconstruction",
            ("benchmarks.reconstruction --seeds 203 --length 351 --truth metro --out {out}",),
            "figures-metro-351.json",
            12.0,
        ),
        Job(
            "fidelity",
            (
                *_SURVEY,
                "benchmarks.fidelity run --scene {out}/scene --recording {out}/survey/survey_os1.bag "
                "--trajectory {out}/survey/groundtruth_os1.tum --truth {out}/survey --out {out}/report",
            ),
            "report/report.json",
            15.0,
        ),
        Job("leaderboard", ("benchmarks.leaderboard --tunnels subterra-351 --out {out}",), "leaderboard.json", 180.0),
    )
}


def run(job: Job, folder: Path, shared: Path) -> Path | None:
    """The job's result, of now or of an earlier run.

    Args:
        job: What to run.
        folder: Its folder.
        shared: Folder of the surveys that are not packaged.

    Returns:
        The file; `None` where what it needs is not here.

    Raises:
        ReproduceError: A command failed.
    """
    result = folder / job.result
    if result.exists():
        return result
    if job.needs and not Path(job.needs.format(shared=shared)).exists():
        return None
    folder.mkdir(parents=True, exist_ok=True)
    for command in job.commands:
        words = [word.format(out=folder, shared=shared) for word in command.split()]
        print(f"$ python -m {' '.join(words)}", flush=True)
        with (folder / "log.txt").open("a") as log:
            status = subprocess.run([sys.executable, "-m", *words], stdout=log, stderr=log, check=False).returncode
        if status and not result.exists():  # a verdict may be a status too
            raise ReproduceError(f"{folder / 'log.txt'}: python -m {words[0]} ended with status {status}")
    return result
