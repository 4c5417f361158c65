"""The fixed list of evaluation episodes: 500 seeds for each task, in a file whose hash is known."""

import dataclasses
import functools
import hashlib
import json
from importlib import resources

import numpy as np

from subterra_jax.faults import N_SEVERITIES
from subterra_jax.host.errors import SubterraError
from subterra_jax.state import EnvParams

SCHEMA = "subterra.evaluation/1"
SHA256 = "4ec196147f6aa4d6f4b3c656cf6d169295718eff9c50046f31743f6de138baa2"
N_LISTED = 500
N_GROUPS = 10


class EvaluationError(SubterraError):
    """The evaluation cannot be done as asked."""


@dataclasses.dataclass(frozen=True)
class Episodes:
    """Episodes to drive. Everything random in one of them comes from its seed alone.

    Attributes:
        seed: One for each, `(n,)`.
        tunnel: Which tunnel of a stack, `(n,)`; 0 where there is one.
        severity: Severity of the faults, `(n,)`; 0 where there are none.
        group: Stratum of the bootstrap, `(n,)`.
    """

    seed: np.ndarray
    tunnel: np.ndarray
    severity: np.ndarray
    group: np.ndarray

    def __len__(self) -> int:
        return len(self.seed)


def listed_seeds(task: str) -> np.ndarray:
    """The 500 seeds of a task, `(500,)`.

    Raises:
        EvaluationError: The packaged list is not the one this code belongs to, or has no such task.
    """
    tasks = _listed()
    if task not in tasks:
        raise EvaluationError(f"the evaluation list has no task {task!r}; it has {', '.join(tasks)}")
    return np.asarray(tasks[task], np.uint32)


@functools.cache
def _listed() -> dict[str, list[int]]:
    data = (resources.files("subterra_jax") / "data" / "evaluation.json").read_bytes()
    found = hashlib.sha256(data).hexdigest()
    if found != SHA256:
        raise EvaluationError(f"data/evaluation.json has SHA-256 {found}, not {SHA256}: scores would not be comparable")
    return json.loads(data)["tasks"]


def listed_episodes(task: str, params: EnvParams, n: int = N_LISTED) -> Episodes:
    """The first `n` episodes of a task, evenly over severities and tunnels.

    Args:
        task: Id of the task.
        params: Its params: whether there are faults, and how many tunnels.
        n: How many, 1 to 500.

    Returns:
        Episodes in `N_GROUPS` groups of neighbours (fewer where `n` is smaller), each of which has all severities
        where it is large enough.

    Raises:
        EvaluationError: `n` is out of range, or see `listed_seeds`.
    """
    if not 1 <= n <= N_LISTED:
        raise EvaluationError(f"episodes must be 1 to {N_LISTED}, got {n}")
    index = np.arange(n)
    low, high = 0, 0
    if params.faults is not None:
        low, high = int(np.min(params.faults.severity_low)), int(np.max(params.faults.severity_high))
        assert 0 <= low <= high < N_SEVERITIES
    n_severities = high - low + 1
    return Episodes(
        seed=listed_seeds(task)[:n],
        tunnel=(index // n_severities % params.tunnel.count).astype(np.int32),
        severity=(low + index % n_severities).astype(np.int32),
        group=(index * N_GROUPS // max(n, N_GROUPS)).astype(np.int32),
    )


def draw_list(tasks: tuple[str, ...]) -> bytes:
    """The list as its file holds it; a task's seeds depend on its name alone.

    The seeds lie above 2³⁰, far from the small numbers that people train with.
    """
    seeds = {
        task: (2**30 + _hashed(task).choice(2**30, N_LISTED, replace=False, shuffle=True)).tolist() for task in tasks
    }
    lines = ",\n".join(
        f" {json.dumps(task)}: {json.dumps(of_task, separators=(',', ':'))}" for task, of_task in seeds.items()
    )
    return f'{{"schema": "{SCHEMA}", "tasks": {{\n{lines}\n}}}}\n'.encode()


def _hashed(task: str) -> np.random.Generator:
    """A generator that belongs to a name."""
    digest = hashlib.sha256(f"{SCHEMA} {task}".encode()).digest()
    return np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16], "little")))
