"""Brax-style PPO over batches of tunnels: `python -m train.navigate`, `python -m train.evaluate`."""
