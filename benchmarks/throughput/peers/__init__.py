"""Who else steps: each file one environment, its package optional."""
