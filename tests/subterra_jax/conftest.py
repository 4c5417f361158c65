"""Shapes and dtypes in the simulator's annotations are checked while its tests run."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from jaxtyping import install_import_hook

from tests.subterra_jax import checking, tunnels

# Nothing is checked where another room's tests have imported the simulator before: half of it would be.
_FIRST = "subterra_jax.state" not in sys.modules
with install_import_hook("subterra_jax" if _FIRST else (), f"{checking.__name__}.check_functions"):
    import subterra_jax
    from subterra_jax.tunnel.plan import TunnelPlan
    from subterra_jax.tunnel.sources import load_tunnel

    for name in subterra_jax.__all__:  # imported at first use, which must happen under the hook
        # The contract of agents is a protocol, which nobody can check at run time; the second is beside it.
        if name not in ("load_policy", "localisability"):
            getattr(subterra_jax, name)


@pytest.fixture(scope="session")
def plan_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[dict[str, Any]], TunnelPlan]:
    """Arrays of a tunnel, through a file, to what the simulator reads."""
    folder = tmp_path_factory.mktemp("tunnels")

    def write_and_load(arrays: dict[str, Any]) -> TunnelPlan:
        path: Path = tunnels.write_tunnel(folder / f"{len(list(folder.iterdir()))}.npz", arrays)
        return load_tunnel(path)

    return write_and_load
