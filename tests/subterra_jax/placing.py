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
from flax import struct


def placed(env, params, x, y=0.0, heading=0.0):
    _, state = env.reset(jax.random.key(0), params)
    number = jnp.float32
    return dataclasses.replace(
        state, position=jnp.array([x, y], number), heading=number(heading), station=number(x), lateral=number(y)
    )


_observe = jax.jit(lambda env, *rest: env.observe(*rest), static_argnums=0)  # one program for all that observe alike


def observe(env, state, params, key=1):
    flat = _observe(env, state, env.draw_step(jax.random.key(key), (), params), params)
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


@struct.dataclass
class Probe:
    """Drives at 0.1 m/s, and faster by 0.1, 0.2 and 0.4 m/s where it gets the truth, ranges and the map."""

    uses_lidar: bool = struct.field(pytree_node=False, default=False)
    uses_map: bool = struct.field(pytree_node=False, default=False)
    privileged: bool = struct.field(pytree_node=False, default=False)
    name: str = struct.field(pytree_node=False, default="probe")

    def begin(self, key, obs, params):
        return self._gets(obs, params)

    def act(self, key, memory, obs, params, known):
        ranges, tunnel = jnp.maximum(memory, self._gets(obs, params))
        truth = 0.0 if known is None else 1.0
        speed = 0.1 * (1.0 + truth + 2.0 * ranges + 4.0 * tunnel)
        return jnp.stack([speed, 0.0, jnp.nan, 0.0, 0.0]), memory

    def _gets(self, obs: Any, params: Any) -> jax.Array:
        """Return 1 where there are ranges, and 1 where there is a map; else 0."""
        n_beams = params.lidar.n_beams
        ranges = jnp.isfinite(obs.ranges).any() | jnp.isfinite(obs.flat[:n_beams]).any()
        tunnel = params.tunnel
        shapes = jnp.isfinite(tunnel.grid).any() | jnp.isfinite(tunnel.box).any() | jnp.isfinite(tunnel.wall).any()
        return jnp.stack([ranges, shapes]).astype(jnp.float32)


PROBES = {
    "nothing": (Probe(), 0.1),
    "truth": (Probe(privileged=True), 0.2),
    "ranges": (Probe(uses_lidar=True), 0.3),
    "map": (Probe(uses_map=True), 0.5),
}
