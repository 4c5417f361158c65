"""Several processes as one run: started by hand, or found under Slurm, Open MPI and Kubernetes."""

import dataclasses
import os
from collections.abc import Mapping

import jax

from train.errors import ConfigError

# Where each launcher says how many processes it has started, and jax knows how to find the rest.
_COUNTS = {"Slurm": "SLURM_STEP_NUM_TASKS", "Open MPI": "OMPI_COMM_WORLD_SIZE"}
# An indexed job of Kubernetes says which of its pods this is; that it has several, only `--processes` does.
_POD = "JOB_COMPLETION_INDEX"


@dataclasses.dataclass(frozen=True)
class Cluster:
    """Which processes train together; nothing given: as the launcher says, or this process alone.

    Attributes:
        coordinator: Address and port of process 0, `host:port`.
        processes: How many there are.
        process: Which this is, from 0; in an indexed job of Kubernetes it need not be given.
    """

    coordinator: str | None = None
    processes: int | None = None
    process: int | None = None


def found(environment: Mapping[str, str]) -> str | None:
    """The launcher that has started several processes, by its environment; None if there is none."""
    for name, count in _COUNTS.items():
        if environment.get(count, "1").isdigit() and int(environment.get(count, "1")) > 1:
            return name
    return None


def resolved(given: Cluster, environment: Mapping[str, str]) -> Cluster:
    """The settings with the process that Kubernetes names.

    Raises:
        ConfigError: Some are given and others are missing or out of range.
    """
    if given == Cluster():
        return given
    pod = environment.get(_POD)
    process = given.process if given.process is not None or pod is None else int(pod)
    if given.coordinator is None or given.processes is None or process is None:
        raise ConfigError("coordinator, processes and process must be given together")
    if not 0 <= process < given.processes:
        raise ConfigError(f"process must lie between 0 and processes - 1 = {given.processes - 1}, got {process}")
    return dataclasses.replace(given, process=process)


def join(given: Cluster) -> None:
    """Joins the other processes, if there are any; before anything else is asked of jax.

    Raises:
        ConfigError: As `resolved`.
    """
    settings = resolved(given, os.environ)
    if settings.coordinator is not None:
        jax.distributed.initialize(settings.coordinator, settings.processes, settings.process)
    elif found(os.environ):
        jax.distributed.initialize()


def leads() -> bool:
    """Whether this process writes the run folder and speaks to the user."""
    return jax.process_index() == 0
