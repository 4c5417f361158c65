"""A robot at a chosen place, programs for a GPU where there is none, and pictures drawn in a process of their own."""

import dataclasses
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest


def placed(env, params, x, y=0.0, heading=0.0):
    _, state = env.reset(jax.random.key(0), params)
    number = jnp.float32
    return dataclasses.replace(
        state, position=jnp.array([x, y], number), heading=number(heading), station=number(x), lateral=number(y)
    )


def observe(env, state, params, key=1):
    flat = jax.jit(env.observe)(state, env.draw_step(jax.random.key(key), (), params), params)
    return {name: np.asarray(flat[at]) for name, at in env.fields(params).items()}


def for_nvidia(function: Callable[..., Any], *arguments: Any) -> str:
    """The text of a program; `jax.default_backend` must say "gpu"."""
    check = jax.export.DisabledSafetyCheck.custom_call("__gpu$xla.gpu.triton")
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(jnp.shape(leaf), leaf.dtype), arguments)
    # From JAX 0.11 on Pallas asks which GPU it is.
    device = jax.sharding.AbstractDevice("NVIDIA H100 80GB HBM3", 132, "gpu")
    with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((1,), ("x",), abstract_device=device)):
        export = jax.export.export(jax.jit(function), platforms=["cuda"], disabled_checks=[check])
        return export(*shapes).mlir_module()


def draw(code: str, file: Path, *words: str) -> tuple[np.ndarray, str]:
    """The picture that a program saves as its first argument, and what it said; skips where there is no OpenGL."""
    line = [sys.executable, "-c", code, str(file), *words]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if "cannot draw" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    return np.load(file), done.stderr
