"""From a task and settings to the layout of a belief."""

import dataclasses
from typing import Any

from train.belief.config import BeliefConfig
from train.belief.network import BeliefLayout


def layout_of(env: Any, params: Any, config: BeliefConfig) -> BeliefLayout:
    """What a checkpoint and a released policy carry."""
    bounds = env.action_space(params)
    return BeliefLayout(
        action_low=tuple(float(x) for x in bounds.low[:2]),
        action_high=tuple(float(x) for x in bounds.high[:2]),
        hidden=tuple(config.hidden),
        habits=dataclasses.asdict(config.habits),
    )
