"""From whatever names a driver to the agent that drives a task: for board, recorder, viewer and `load_policy`."""

import inspect
from pathlib import Path
from typing import Any

from subterra_jax.baselines import registry
from subterra_jax.baselines.agent import Agent
from subterra_jax.baselines.registry import AgentError
from subterra_jax.compiled import in_32_bits
from subterra_jax.host.loading import load_object
from subterra_jax.policies.files import PolicyError, is_policy
from subterra_jax.policies.loading import PREFIX, check_fits, load
from subterra_jax.policies.trained import Trained
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

TRAITS = ("uses_lidar", "uses_map", "privileged")
FORMS = "policy:NAME, policy:FILE, policy:RUN-FOLDER, module:Class or FILE.py:Class"


def policy_source(name: str) -> str | None:
    """Returns the file, folder or released name of a trained policy; None where `name` names no such thing.

    Args:
        name: `policy:SOURCE`, a `.safetensors` file, a run folder, or the name of a released policy.
    """
    if name.startswith(PREFIX):
        return name.removeprefix(PREFIX)
    return name if is_policy(name) else None


def names_code(name: str) -> bool:
    """Returns True for `module:Class` and `FILE.py:Class`."""
    return ":" in name and name not in registry.names() and not name.startswith(PREFIX)


@in_32_bits()
def open_agent(source: Any, env: TunnelEnv, params: EnvParams) -> Agent:
    """Makes the agent that drives a task.

    Args:
        source: A baseline by name; a trained policy as for `policy_source`; `module:Class` or `FILE.py:Class`; or an
            agent. A class, or a function that makes an agent, is called with the task's params where it has a parameter
            without a default.

    Raises:
        AgentError: There is no such agent, or it lacks part of the contract.
        PolicyError: The policy is missing or damaged, or does not fit the task.
        UserCodeError: The class cannot be loaded.
    """
    agent = _make(source, params)
    if isinstance(agent, Trained):
        check_fits(agent, env, params, str(source) if isinstance(source, (str, Path)) else agent.name)
        return agent.with_map(params)
    if missing := [one for one in (*TRAITS, "name", "begin", "act") if not hasattr(agent, one)]:
        raise AgentError(f"agent {str(source)!r} has no {', '.join(missing)}")
    return agent


def _make(source: Any, params: EnvParams) -> Any:
    if not isinstance(source, (str, Path)):
        return call_factory(source, params) if callable(source) else source
    name = str(source)
    if name in registry.names():
        return registry.make_agent(name, params)
    if (policy := policy_source(name)) is not None:
        agent, facts = load(policy)
        if not isinstance(agent, Trained):
            raise PolicyError(f"{name}: a policy of kind {facts['kind']!r}, which moves legs and drives no task")
        return agent
    if names_code(name):
        return call_factory(load_object(name), params)
    raise AgentError(_no_agent(name))


def require_known(name: str) -> None:
    """Refuses a name of no baseline, policy or class, before a task is known.

    Raises:
        AgentError: There is no such agent.
    """
    if name not in registry.names() and policy_source(name) is None and not names_code(name):
        raise AgentError(_no_agent(name))


def _no_agent(name: str) -> str:
    return f"no agent {name!r}; there are {', '.join(registry.names())}; or {FORMS}"


def call_factory(factory: Any, params: EnvParams) -> Any:
    """Calls a class, or a function that makes an agent; with the task's params where it cannot do without."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return factory
    needs_params = any(one.default is one.empty for one in parameters if one.kind is one.POSITIONAL_OR_KEYWORD)
    return factory(params) if needs_params else factory()
