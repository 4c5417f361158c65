"""Gymnasium's registry: every task under its id."""

from gymnasium.envs import registration

from subterra_jax.tasks import TASKS

_SINGLE = "subterra_jax.adapters.single:SubterraEnv"
_VECTOR = "subterra_jax.adapters.vector:SubterraVectorEnv"


def register() -> None:
    """Make every task known to Gymnasium under its id; doing so again changes nothing."""
    for task in TASKS:
        if task not in registration.registry:
            registration.register(id=task, entry_point=_SINGLE, vector_entry_point=_VECTOR, kwargs={"task": task})
