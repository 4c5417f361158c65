"""The ids of the benchmark's tasks, without jax; and the sentence for an id that does not exist."""

from collections.abc import Iterable

PLANAR = tuple(
    f"Subterra/{name}-v1"
    for name in ("Traverse", "TraverseShort", "StopAt", "StopAtShort", "Return", "Obstructed", "Faulted", "Relocalise")
)
WALK = "Subterra/B2Walk-v1"
B2_TRAVERSE = "Subterra/B2Traverse-v1"
MISSIONS = (B2_TRAVERSE,)  # planar tasks, done on a learnt gait
BENCHMARK = (*PLANAR, WALK, *MISSIONS)


def full_id(name: str) -> str:
    """Return `Subterra/StopAt-v1` for `StopAt` and `StopAt-v1`; any other name unchanged."""
    full = f"Subterra/{name.removesuffix('-v1')}-v1"
    return full if full in BENCHMARK else name


def no_task(task: str, known: Iterable[str]) -> str:
    """Explain in one sentence that a task id does not exist, and which id to use.

    Args:
        task: The id as it was given, with `Subterra/` or without.
        known: The ids that exist.
    """
    name = task.removeprefix("Subterra/").partition("-v")[0]
    if (meant := full_id(name)) in BENCHMARK:
        return f"no task {task!r}: its id is {meant}"
    return f"no task {task!r}; there are {', '.join(known)}"
