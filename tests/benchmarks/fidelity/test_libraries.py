"""The column `lib` of the table says what the code calls."""

from importlib import metadata

import pytest

from benchmarks.fidelity import table
from tests.benchmarks.fidelity.libraries import libraries

INSTALLED = {"embreex", "shapely", "trimesh", "mujoco", "jax", "py4dgeo", "pymeshlab", "gudhi", "manifold3d"}


@pytest.mark.parametrize("id", table.load())
def test_the_table_names_the_libraries_that_the_code_of_a_metric_calls(id: str) -> None:
    assert table.load()[id].library == libraries()[id]


def test_libraries_are_found_where_they_are_known_to_be_called() -> None:
    called = {id: set(text.split("; ")) for id, text in libraries().items()}
    assert called["m3c2_signif_frac"] >= {"py4dgeo"}
    assert called["deg_icp_axial_logratio"] >= {"small-gicp"}
    assert called["mesh_self_intersections"] >= {"pymeshlab"}
    assert called["mjx_put_model"] >= {"mujoco-mjx", "jax"}
    assert called["topo_free_b0"] >= {"connected-components-3d"}
    assert called["mesh_finite"] == {"numpy"}
    assert "embreex" not in called["c2m_mean"]  # a distance, no ray


def test_every_named_library_is_installed() -> None:
    names = {name.split(".")[0] for row in table.load().values() for name in row.library.split("; ")}
    assert names >= INSTALLED
    for name in names - {"subterra_jax", "scene"}:
        metadata.version(name)
