"""An adapter without its library says what to install."""

import importlib
import sys

import pytest

import subterra_jax as st
from subterra_jax.pictures.views import make_view


@pytest.mark.parametrize(
    ("adapter", "library", "package"),
    [
        ("sb3", "stable_baselines3.common.vec_env.base_vec_env", "stable-baselines3"),
        ("brax", "brax.envs.base", r"'subterra-jax\[brax\]'"),
    ],
)
def test_a_missing_library_is_named_with_the_command_that_installs_it(adapter, library, package, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"subterra_jax.adapters.{adapter}", raising=False)
    with pytest.raises(st.SubterraError, match=f"pip install {package}$") as caught:
        importlib.import_module(f"subterra_jax.adapters.{adapter}")
    assert isinstance(caught.value, ImportError)


def test_a_view_without_mujoco_names_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(st.SubterraError, match=r"pip install mujoco$") as caught:
        make_view("mujoco")
    assert isinstance(caught.value, ImportError)
