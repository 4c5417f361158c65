"""Subterra through other libraries' interfaces: Gymnasium (single and vector), Stable-Baselines3, Brax, Gymnax.

Each file needs its own library, and none is imported before its first use.
"""

from collections.abc import Sequence

from subterra_jax.host.task_ids import MISSIONS, PLANAR, WALK

_SINGLE = "subterra_jax.adapters.single:SubterraEnv"
_VECTOR = "subterra_jax.adapters.vector:SubterraVectorEnv"
# MuJoCo is loaded only where one of these is made.
_ON_LEGS = "subterra_jax.b2.gym:B2Env"


def register_tasks(tasks: Sequence[str] = PLANAR) -> None:
    """Make planar tasks, and those on legs, known to Gymnasium under their ids; doing so again changes nothing."""
    from gymnasium.envs import registration  # optional

    for task in tasks:
        if task not in registration.registry:
            registration.register(id=task, entry_point=_SINGLE, vector_entry_point=_VECTOR, kwargs={"task": task})
    for task in (WALK, *MISSIONS):
        if task not in registration.registry:
            registration.register(id=task, entry_point=_ON_LEGS, kwargs={"task": task})
