"""Errors that a user can cause, each with one clear sentence."""


class SubterraError(Exception):
    """Base of every error that Subterra raises on purpose; a command prints it as one sentence.

    Attributes:
        exit_status: Exit status of a command that ends with this error.
    """

    exit_status = 2


class TunnelError(SubterraError):
    """A tunnel file cannot be read, or one of its fields is wrong."""


class OutputError(SubterraError):
    """An output cannot be written where it was asked for."""


class MissingLibraryError(SubterraError, ImportError):
    """A module was used without the library that it needs.

    Args:
        module: The module that needs the library.
        package: The library's name for pip.
        extra: The optional dependencies of this package that bring it; None where it has to be installed by itself.
    """

    def __init__(self, module: str, package: str, extra: str | None = None):
        install = package if extra is None else f"'subterra-jax[{extra}]'"
        super().__init__(f"{module} needs {package}, which is not installed: pip install {install}", name=package)
