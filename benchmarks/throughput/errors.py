"""What a user of the benchmark can get wrong."""

from subterra_jax.host.errors import SubterraError


class ThroughputError(SubterraError):
    """A measurement that cannot be made as it was asked for."""
