"""PPO over batches of tunnels: `python -m train`, `python -m train.evaluate`, `python -m train.release`."""

from subterra_jax.host.command import require_libraries

require_libraries("train", "train", "tyro", "rich", "matplotlib", "orbax.checkpoint", "safetensors")
