"""What is said where a library that an adapter needs is not installed."""

from subterra_jax.errors import SubterraError


class MissingLibraryError(SubterraError, ImportError):
    """An adapter was imported without the library that it adapts to."""

    def __init__(self, module: str, package: str):
        super().__init__(f"{module} needs {package}, which is not installed: pip install {package}", name=package)
