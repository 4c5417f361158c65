"""The rules of the tasks, one file each: params, start, verdict, reward; `rule.py` is their contract."""

from subterra_jax.rules.relocalise import Relocalise
from subterra_jax.rules.rule import Choice, Rule, Start, StartParams, Verdict
from subterra_jax.rules.stop import GoalParams, GoalRewardParams, ReportParams, StopAt
from subterra_jax.rules.traverse import RewardParams, Traverse
from subterra_jax.rules.turn_back import TurnBack

__all__ = [
    "Choice",
    "GoalParams",
    "GoalRewardParams",
    "Relocalise",
    "ReportParams",
    "RewardParams",
    "Rule",
    "Start",
    "StartParams",
    "StopAt",
    "Traverse",
    "TurnBack",
    "Verdict",
]
