"""What a user of this benchmark can get wrong."""

from subterra_jax.errors import SubterraError


class SlamError(SubterraError):
    """Recordings that cannot be made or read, or a trajectory that cannot be scored."""
