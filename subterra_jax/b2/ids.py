"""Ids of the tasks on legs, known without loading MuJoCo."""

WALK = "Subterra/B2Walk-v0"
TRAVERSE = "Subterra/B2Traverse-v0"
MISSIONS = (TRAVERSE,)  # driven as the planar tasks are, on a learnt gait
