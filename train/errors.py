"""Errors of training, each with one clear sentence."""

from subterra_jax.host.command import EXIT_FAILED
from subterra_jax.host.errors import SubterraError


class ConfigError(SubterraError, ValueError):
    """A setting, or a combination of settings, that no training run can have."""


class CheckpointError(SubterraError):
    """A checkpoint is missing, damaged, or belongs to another network or run."""


class RunFolderError(SubterraError):
    """The output folder cannot be written, or already holds something else."""


class TrainingError(SubterraError):
    """Training came to a point from which it cannot go on."""

    exit_status = EXIT_FAILED
