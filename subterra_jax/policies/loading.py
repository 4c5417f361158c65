"""From tensors and facts to an agent, and whether it fits a task."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from subterra_jax.baselines import registry
from subterra_jax.baselines.agent import Observed, n_ranges
from subterra_jax.compiled import in_32_bits
from subterra_jax.policies import belief, senses
from subterra_jax.policies.belief import Belief, Habits
from subterra_jax.policies.files import GAIT, Conditions, PolicyError, PolicyFile, read, released
from subterra_jax.policies.locate import agent as locate
from subterra_jax.policies.locate.agent import Locating
from subterra_jax.policies.networks import FeedForward, Recurrent
from subterra_jax.state import EnvParams
from subterra_jax.tasks import TASKS, constants_digest
from subterra_jax.tunnel_env import TunnelEnv

Agent = FeedForward | Recurrent | Belief | Locating
KINDS = ("mlp", "gru", belief.KIND, locate.KIND)
PREFIX = "policy:"  # of the names of released policies among the agents


@in_32_bits()
def load(source: str | Path) -> tuple[Any, dict[str, Any]]:
    """A policy and its facts: an `Agent`, or of a gait the `WalkPolicy` of `subterra_jax.b2.gait`.

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
) -> Agent:
    """An agent of tensors in memory.

    Args:
        kind: One of `KINDS`.
        layout: `action_low`, `action_high`, and `frames`, `bin_width`, `habits` or `network`.
        tensors: By name, as the agent's class says.
        name: Name on the leaderboard.
        conditions: Conditions of its training, which `check_fits` compares; None: any.

    Raises:
        KeyError: Something is missing in the layout.
        ValueError: There is no such kind.
    """
    low, high = (jnp.asarray(layout[key], jnp.float32) for key in ("action_low", "action_high"))
    arrays = {key: jnp.asarray(value) for key, value in tensors.items()}
    if kind == "mlp":
        return FeedForward(arrays, low, high, frames=int(layout["frames"]), name=name, conditions=conditions)
    if kind == "gru":
        if (version := int(layout.get("senses", 1))) != senses.VERSION:
            raise ValueError(f"made for senses of version {version}, this release has {senses.VERSION}; train it anew")
        shown = senses.Senses(str(layout.get("tracker", "loop")), bool(layout.get("boxes", False)))
        width = float(layout["bin_width"])
        image = tuple(layout["image"]) if layout.get("image") else None
        return Recurrent(arrays, low, high, bin_width=width, shown=shown, image=image, name=name, conditions=conditions)
    if kind == belief.KIND:
        return Belief(arrays, low, high, habits=Habits(**layout["habits"]), name=name, conditions=conditions)
    if kind == locate.KIND:
        return Locating(arrays, low, high, network=str(layout["network"]), name=name, conditions=conditions)
    raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")


def with_map(agent: Any, params: EnvParams) -> Any:
    """Returns the agent with the map of a task if it uses one, any other unchanged."""
    return agent.with_map(params) if isinstance(agent, Belief) else agent


def check_fits(agent: Agent, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
    """Refuses a policy that cannot drive here, or was trained under other conditions.

    Raises:
        PolicyError: As `check_task`; or control period, beams, fields or constants are others than in training.
    """
    check_task(agent, env, params, source)
    if agent.conditions is not None:
        _check_conditions(agent.conditions, training_conditions(env, params), source)


def check_task(agent: Agent, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
    """Refuses a policy of another task: one that cannot read the observation, or has learnt something else.

    Raises:
        PolicyError: Observations, errand, actions or control period are others than those it was trained with.
    """
    size, bounds, errand = env.observation_size(params), env.action_space(params), env.rule.errand
    if isinstance(agent, Recurrent):
        if errand not in ("stop", "return"):
            raise PolicyError(f"{source}: a policy that drives to a goal and stops, which {env.id} does not ask for")
        wanted, made_for = n_ranges(params), agent.n_beams
        if wanted != made_for:
            raise PolicyError(f"{source}: made for {made_for} beams, {env.id} has {wanted}")
        if (image := env.images(params).get("scan")) != agent.image:
            raise PolicyError(f"{source}: made for images of shape {agent.image}, {env.id} has {image}")
    elif isinstance(agent, Belief):
        if errand != "report":
            raise PolicyError(f"{source}: a policy that finds out where it is, which {env.id} does not ask for")
    elif isinstance(agent, Locating):
        if errand not in locate.ERRANDS:
            raise PolicyError(f"{source}: a localiser on its way to a goal, without a map; {env.id} asks to {errand}")
        if (n := n_ranges(params)) % 16:
            raise PolicyError(f"{source}: needs 16 level beams or a multiple of them, {env.id} has {n}")
    elif agent.n_observation != size:
        raise PolicyError(f"{source}: made for observations of {agent.n_observation} numbers, {env.id} has {size}")
    conditions = agent.conditions
    if conditions is not None:
        _check_period(conditions.period, _period(params), source, env.id)
        learnt = TASKS[conditions.task].rule.errand if conditions.task in TASKS else errand
        if learnt != errand and not isinstance(agent, Locating):  # what a localiser has learnt is not the errand
            raise PolicyError(f"{source}: has learnt {conditions.task} (to {learnt}); {env.id} asks to {errand}")
    high = np.asarray(agent.high)
    if not np.allclose(high, bounds.high[: len(high)]):
        raise PolicyError(f"{source}: made for actions up to {high.tolist()}, {env.id} has {bounds.high.tolist()}")


def training_conditions(env: Any, params: Any) -> Conditions:
    """Returns the conditions of an environment, as a policy that is trained in it carries them."""
    fields, constants = tuple(env.fields(params)), constants_digest(env, params)
    return Conditions(env.id, _period(params), int(params.lidar.n_beams), fields, constants)


def _check_conditions(trained: Conditions, here: Conditions, source: str | Path) -> None:
    """Refuses conditions that are others than those of the training, where those are known."""
    if trained.n_beams not in (None, here.n_beams):
        raise PolicyError(f"{source}: trained with {trained.n_beams} beams, {here.task} has {here.n_beams}")
    if trained.fields not in (None, here.fields):
        names, present = ", ".join(trained.fields or ()), ", ".join(here.fields or ())
        raise PolicyError(f"{source}: trained on the fields {names}; {here.task} has {present}")
    # Another task has other constants, and it may be asked how a policy does there.
    if trained.task == here.task and trained.constants not in (None, here.constants):
        was, present = (trained.constants or "")[:12], (here.constants or "")[:12]
        raise PolicyError(f"{source}: trained under constants {was} of {here.task}, which has {present} here")


def _check_period(trained: float, here: float, source: str | Path, task: str) -> None:
    """Refuses another control period: with half of it, dead reckoning would count every step double."""
    if abs(trained - here) > 1e-6:
        raise PolicyError(f"{source}: trained with a control period of {trained:g} s, {task} has {here:g} s")


def _period(params: Any) -> float:
    """Returns the control period of a task, s."""
    return round(float(np.max(np.asarray(params.vehicle.period))), 6)


def register_released() -> tuple[str, ...]:
    """Adds every released policy that drives to the baselines, as `policy:NAME`; those there already stay.

    Returns:
        Their names.
    """
    names = tuple(PREFIX + name for name in released() if not name.startswith("B2"))
    for name in names:
        if name not in registry.names():
            registry.register(name, functools.partial(_make_released, name.removeprefix(PREFIX)))
    return names


def _make_released(name: str, params: EnvParams) -> Agent:
    """Makes the agent of a released policy for a task.

    Raises:
        PolicyError: It was trained with another control period.
    """
    agent, _ = load(name)
    _check_period(agent.conditions.period, _period(params), name, "this task")
    return with_map(agent, params)


def _checked(file: PolicyFile) -> Agent:
    """The agent of a file, driven once on paper so that a missing or misshapen tensor is found here."""
    facts = file.facts
    try:
        agent = from_tensors(facts["kind"], facts["layout"], file.tensors, facts["name"], Conditions.from_facts(facts))
        _try(agent)
    except (KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"{file.path}: tensors and layout do not belong together ({error})") from error
    return agent


def _try(agent: Agent) -> None:
    """Lets it act on shapes alone."""
    if isinstance(agent, FeedForward):
        jax.eval_shape(agent.answer, jax.ShapeDtypeStruct((agent.frames, agent.n_observation), jnp.float32))
        return
    if isinstance(agent, Belief):
        jax.eval_shape(belief.try_scan, agent.tensors)
        return
    if isinstance(agent, Locating):
        locate.check_tensors(agent)
        return
    zero, ranges = jnp.zeros(()), jnp.zeros(agent.n_beams)
    entries = {} if agent.image is None else {"scan": jnp.zeros(agent.image[0] * agent.image[1])}
    seen = Observed(ranges, ranges, distance=zero, heading=zero, goal=zero, ring_pitch=zero, entries=entries)
    jax.eval_shape(agent.answer, agent.blank(), seen, zero)
