"""Errors of this room."""

from subterra_jax.host.errors import SubterraError


class ReproduceError(SubterraError):
    """A number cannot be measured again."""
