"""PPO with memory: a GRU that carries where it is, for tasks whose reward alone does not teach it."""
