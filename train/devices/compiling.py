"""How this room compiles."""

import jax


def options() -> dict[str, str | bool] | None:
    """Compiler options under which one seed gives one result.

    A CPU needs none. On a GPU, XLA otherwise chooses kernels by timing them, and two runs of one seed part after an
    iteration or two. Measured on an H200, the deterministic kernels cost PPO about 3 % of its speed.
    """
    return None if jax.default_backend() == "cpu" else {"xla_gpu_deterministic_ops": True}
