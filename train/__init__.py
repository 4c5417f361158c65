"""Brax-style PPO over batches of tunnels: `python -m train.navigate`, `python -m train.evaluate`."""

from subterra_jax.host.command import require_libraries

require_libraries("train", "train", "tyro", "rich", "matplotlib", "orbax.checkpoint", "safetensors", "brax")
