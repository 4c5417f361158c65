"""Finished controls on disk, so that a run that was cut short goes on where it was."""

from dataclasses import dataclass
from pathlib import Path

from benchmarks.fidelity import store
from benchmarks.fidelity.value import Value

SCHEMA = "subterra.fidelity-control/1"


@dataclass(frozen=True)
class Job:
    """One control at one dose; an invariance has dose 0."""

    control: str
    dose: float

    @property
    def name(self) -> str:
        """For files."""
        return f"{self.control}-{self.dose:g}"


@dataclass(frozen=True)
class Outcome:
    """What a control did.

    Attributes:
        job: Which.
        values: All 199.
        leaks: What the leak detector said.
    """

    job: Job
    values: dict[str, Value]
    leaks: list[str]


def read(folder: Path | None, job: Job, key: str) -> Outcome | None:
    """What an earlier run of the same base left for a job; `None` where nothing did."""
    path = None if folder is None else folder / f"{job.name}.json"
    if path is None or not path.exists():
        return None
    content = store.read_json(path, SCHEMA)
    if content["key"] != key:
        return None
    return Outcome(job, store.load_values(content["values"]), content["leaks"])


def write(folder: Path | None, outcome: Outcome, key: str) -> None:
    """Keeps an outcome; without a folder nothing is kept."""
    if folder is not None:
        content = {"schema": SCHEMA, "key": key, "values": store.dump_values(outcome.values), "leaks": outcome.leaks}
        store.write_json(folder / f"{outcome.job.name}.json", content, digits=17)
