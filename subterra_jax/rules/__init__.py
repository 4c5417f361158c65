"""What each task asks: how an episode's goal is drawn, what is observed of it, when it ends and what it pays."""

from subterra_jax.rules.relocalise import Relocalise
from subterra_jax.rules.rule import Rule, Step, Verdict
from subterra_jax.rules.stop import StopAt
from subterra_jax.rules.traverse import Traverse
from subterra_jax.rules.turn_back import TurnBack

__all__ = ["Relocalise", "Rule", "Step", "StopAt", "Traverse", "TurnBack", "Verdict"]
