"""Shapes and dtypes in the simulator's annotations are checked while its tests run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from jaxtyping import install_import_hook

from tests.subterra_jax import checking, tunnels

# A no-op where another room's tests have imported the simulator before.
with install_import_hook("subterra_jax", f"{checking.__name__}.check_functions"):
    from subterra_jax.tunnel.plan import TunnelPlan
    from subterra_jax.tunnel.sources import load_tunnel


@pytest.fixture(scope="session")
def plan_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[dict[str, Any]], TunnelPlan]:
    """Arrays of a tunnel, through a file, to what the simulator reads."""
    folder = tmp_path_factory.mktemp("tunnels")

    def write_and_load(arrays: dict[str, Any]) -> TunnelPlan:
        path: Path = tunnels.write_tunnel(folder / f"{len(list(folder.iterdir()))}.npz", arrays)
        return load_tunnel(path)

    return write_and_load
