"""The fixed list of evaluation episodes: 500 seeds for each task, in a file whose hash is known."""

import dataclasses
import functools
import hashlib
import json
from importlib import resources

import numpy as np

from subterra_jax.host.errors import SubterraError
from subterra_jax.state import EnvParams
from subterra_jax.tasks import TASKS
from subterra_jax.tunnel_env import TunnelEnv

SCHEMA = "subterra.evaluation/1"
SHA256 = "1c7d30cd26d502c01e24f291fbe7d130d32b5b570780fa749787296d3b0bd58f"
N_LISTED = 500
N_GROUPS = 10


class EvaluationError(SubterraError):
    """The evaluation cannot be done as asked."""


@dataclasses.dataclass(frozen=True)
class Episodes:
    """Episodes to drive. Everything random in an episode comes from its seed alone."""

    seed: np.ndarray  # seeds, `(n,)`
    tunnel: np.ndarray  # number of the tunnel in a stack, `(n,)`; 0 where there is one
    severity: np.ndarray  # severity of the faults, `(n,)`; 0 where there are none
    group: np.ndarray  # stratum of the bootstrap, `(n,)`

    def __len__(self) -> int:
        return len(self.seed)


def listed_seeds(task: str) -> np.ndarray:
    """Return the 500 seeds of a task, `(500,)`; a task from outside the benchmark gets seeds by the same rule.

    Raises:
        EvaluationError: The packaged list is not the one this code belongs to, or there is no such task.
    """
    listed = _listed()
    if task in listed:
        return np.asarray(listed[task], np.uint32)
    if task not in TASKS:
        raise EvaluationError(f"no task {task!r}; there are {', '.join(TASKS)}")
    return draw_seeds(task)


@functools.cache
def _listed() -> dict[str, list[int]]:
    data = (resources.files("subterra_jax") / "data" / "evaluation.json").read_bytes()
    found = hashlib.sha256(data).hexdigest()
    if found != SHA256:
        raise EvaluationError(f"data/evaluation.json has SHA-256 {found}, not {SHA256}: scores would not be comparable")
    return json.loads(data)["tasks"]


def listed_episodes(env: TunnelEnv, params: EnvParams, n: int = N_LISTED) -> Episodes:
    """Return the first `n` episodes of a task, evenly over severities and tunnels.

    Args:
        n: Number of episodes, 1 to 500.

    Returns:
        Episodes in `N_GROUPS` groups of neighbours (fewer where `n` is smaller), each of which has all severities
        where it is large enough.

    Raises:
        EvaluationError: `n` is out of range, or see `listed_seeds`.
    """
    if not 1 <= n <= N_LISTED:
        raise EvaluationError(f"episodes must be 1 to {N_LISTED}, got {n}")
    index, levels = np.arange(n), np.asarray(env.levels(params))
    return Episodes(
        seed=listed_seeds(env.id)[:n],
        tunnel=(index // len(levels) % params.tunnel.count).astype(np.int32),
        severity=levels[index % len(levels)].astype(np.int32),
        group=(index * N_GROUPS // max(n, N_GROUPS)).astype(np.int32),
    )


def draw_seeds(task: str) -> np.ndarray:
    """Draw the seeds of a task, `(500,)`; they depend on its name alone.

    They lie above 2³⁰, far from the small numbers that people train with.
    """
    digest = hashlib.sha256(f"{SCHEMA} {task}".encode()).digest()
    generator = np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16], "little")))
    return (2**30 + generator.choice(2**30, N_LISTED, replace=False, shuffle=True)).astype(np.uint32)
