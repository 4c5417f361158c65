"""Brax-style PPO over batches of tunnels: `python -m train.navigate`, `python -m train.evaluate`."""

from subterra_jax.extras import require

require("train", "train", "tyro", "rich", "matplotlib", "orbax.checkpoint", "safetensors")
