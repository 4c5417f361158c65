"""The errors a caller may want to catch."""


class SubterraError(Exception):
    """Base of every error that Subterra raises on purpose."""


class TunnelError(SubterraError):
    """A tunnel file cannot be read, or one of its fields is wrong."""
