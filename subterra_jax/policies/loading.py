"""From tensors and facts to an agent, and whether it fits a task."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from subterra_jax.compiled import in_32_bits
from subterra_jax.policies.files import GAIT, TRAINED_UNDER, Conditions, PolicyError, PolicyFile, read
from subterra_jax.policies.learnt import Learnt
from subterra_jax.policies.locate.agent import Locating
from subterra_jax.policies.trained import Trained
from subterra_jax.state import EnvParams
from subterra_jax.tasks import TASKS, constants_digest
from subterra_jax.tunnel_env import TunnelEnv

KINDS: dict[str, type[Trained]] = {one.kind: one for one in (Learnt, Locating)}
PREFIX = "policy:"  # of the names of released policies among the agents


@in_32_bits()
def load(source: str | Path) -> tuple[Any, dict[str, Any]]:
    """A policy and its facts: a `Trained`, or of a gait the `WalkPolicy` of `subterra_jax.b2.gait`.

    Args:
        source: A `.safetensors` file, a run folder of `train`, or the name of a released policy.

    Raises:
        PolicyError: It is missing or damaged.
    """
    file = read(source)
    if file.facts["kind"] == GAIT:
        from subterra_jax.b2.gait import make_policy  # it moves legs and drives no task

        return make_policy(file), file.facts
    return _checked(file), file.facts


def from_tensors(
    kind: str, layout: dict[str, Any], tensors: Mapping[str, Any], name: str, conditions: Conditions | None = None
) -> Trained:
    """An agent of tensors in memory.

    Args:
        kind: One of `KINDS`.
        layout: `action_low`, `action_high`, and what `Layout.to_json` or the localiser's class says.
        tensors: By name, as the agent's class says.
        name: Name on the board.
        conditions: Conditions of its training, which `check_fits` compares; None: any.

    Raises:
        KeyError: Something is missing in the layout.
        ValueError: There is no such kind.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    low, high = (jnp.asarray(layout[key], jnp.float32) for key in ("action_low", "action_high"))
    arrays = {key: jnp.asarray(value) for key, value in tensors.items()}
    return KINDS[kind].of_layout(layout, tensors=arrays, low=low, high=high, name=name, conditions=conditions)


def check_fits(agent: Trained, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
    """Refuses a policy that cannot drive here, or was trained under other conditions.

    Raises:
        PolicyError: As `check_task`; or control period, beams, fields or constants are others than in training.
    """
    check_task(agent, env, params, source)
    if agent.conditions is not None:
        _check_conditions(agent.conditions, training_conditions(env, params), source)


def check_task(agent: Trained, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
    """Refuses a policy of another task: one that cannot read the observation, or has learnt something else.

    Raises:
        PolicyError: Observations, goal kind, actions or control period are others than those it was trained with.
    """
    agent.check_task(env, params, source)
    bounds, goal_kind = env.action_space(params), env.rule.goal_kind
    conditions = agent.conditions
    if conditions is not None:
        _check_period(conditions.period, _period(params), source, env.id)
        learnt = TASKS[conditions.task].rule.goal_kind if conditions.task in TASKS else goal_kind
        if agent.learns_goal_kind and learnt != goal_kind:
            raise PolicyError(f"{source}: has learnt {conditions.task} (to {learnt}); {env.id} asks to {goal_kind}")
    high = np.asarray(agent.high)
    if np.any(high > bounds.high[: len(high)] + 1e-6):
        raise PolicyError(f"{source}: made for actions up to {high.tolist()}, {env.id} has {bounds.high.tolist()}")


def training_conditions(env: Any, params: Any) -> Conditions:
    """Returns the conditions of an environment, as a policy that is trained in it carries them.

    How far a hidden start is off is none of them: it changes what a robot is given, not what it senses or does. A robot
    by physics has no digest of constants: it may be asked how any policy does there.
    """
    given = params.replace(start=params.start.replace(station_sigma=0.0))
    fields, constants = tuple(env.fields(params)), constants_digest(env, given) if env.motion.on_the_plan else None
    return Conditions(env.id, _period(params), int(params.lidar.n_beams), fields, constants)


def _check_conditions(trained: Conditions, here: Conditions, source: str | Path) -> None:
    """Refuses conditions that are others than those of the training, where those are known."""
    if trained.n_beams not in (None, here.n_beams):
        raise PolicyError(f"{source}: trained with {trained.n_beams} beams, {here.task} has {here.n_beams}")
    if trained.fields not in (None, here.fields):
        names, present = ", ".join(trained.fields or ()), ", ".join(here.fields or ())
        raise PolicyError(f"{source}: trained on the fields {names}; {here.task} has {present}")
    # Another task has other constants, and it may be asked how a policy does there.
    known = None not in (trained.constants, here.constants)
    if trained.task == here.task and known and trained.constants != here.constants:
        was, present = (trained.constants or "")[:12], (here.constants or "")[:12]
        raise PolicyError(f"{source}: trained under constants {was} of {here.task}, which has {present} here")


def _check_period(trained: float, here: float, source: str | Path, task: str) -> None:
    """Refuses another control period: with half of it, dead reckoning would count every step double."""
    if abs(trained - here) > 1e-6:
        raise PolicyError(f"{source}: trained with a control period of {trained:g} s, {task} has {here:g} s")


def _period(params: Any) -> float:
    """Returns the control period of a task, s."""
    return round(float(np.max(np.asarray(params.vehicle.period))), 6)


def _checked(file: PolicyFile) -> Trained:
    """The agent of a file, driven once on paper so that a missing or misshapen tensor is found here."""
    facts = file.facts
    try:
        conditions = Conditions.from_facts(facts) if TRAINED_UNDER in facts else None
        agent = from_tensors(facts["kind"], facts["layout"], file.tensors, facts["name"], conditions)
        agent.try_out()
    except (KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"{file.path}: tensors and layout do not belong together ({error})") from error
    return agent
