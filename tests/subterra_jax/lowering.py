"""Programs for an NVIDIA GPU, made where there is none: the interpreter takes what Triton refuses."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def for_nvidia(function: Callable[..., Any], *arguments: Any) -> str:
    """The text of a program; `jax.default_backend` must say "gpu"."""
    check = jax.export.DisabledSafetyCheck.custom_call("__gpu$xla.gpu.triton")
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(jnp.shape(leaf), leaf.dtype), arguments)
    # From JAX 0.11 on Pallas asks which GPU it is.
    device = jax.sharding.AbstractDevice("NVIDIA H100 80GB HBM3", 132, "gpu")
    with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((1,), ("x",), abstract_device=device)):
        export = jax.export.export(jax.jit(function), platforms=["cuda"], disabled_checks=[check])
        return export(*shapes).mlir_module()
