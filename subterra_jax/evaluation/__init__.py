"""Scores of an agent on fixed episodes.

episodes (seeds) ─► harness (drive) ─► records (running sums, one record each, means and intervals)
"""

from subterra_jax.evaluation.episodes import Episodes, listed_episodes
from subterra_jax.evaluation.harness import evaluate
from subterra_jax.evaluation.records import Records

__all__ = ["Episodes", "Records", "evaluate", "listed_episodes"]
