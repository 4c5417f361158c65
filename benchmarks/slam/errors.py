"""What a user of this benchmark can get wrong."""

from subterra_jax.host.errors import SubterraError


class SlamError(SubterraError):
    """Recordings that cannot be made or read, or a trajectory that cannot be scored."""
