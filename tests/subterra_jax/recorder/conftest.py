"""One short episode, recorded once for all tests of this folder."""

from pathlib import Path

import pytest

from subterra_jax.recorder import RecorderConfig, record


@pytest.fixture(scope="session")
def config(tmp_path_factory: pytest.TempPathFactory) -> RecorderConfig:
    out: Path = tmp_path_factory.mktemp("episode") / "one"
    where = {"task": "StopAtShort", "tunnel": "subterra-351"}
    return RecorderConfig(out=out, **where, agent="dead-reckoning", episode=1, imu=True)


@pytest.fixture(scope="session")
def trace(config):
    return record(config)
