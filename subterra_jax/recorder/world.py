"""Where an episode happens, who drives, and how it is drawn."""

import dataclasses

import subterra_jax as st
from subterra_jax.baselines.agent import Agent
from subterra_jax.baselines.registry import make_agent
from subterra_jax.env import TunnelEnv
from subterra_jax.evaluation import listed_episodes
from subterra_jax.policies import check_fits, load, told
from subterra_jax.recorder.config import Recording, RecordingError
from subterra_jax.state import EnvParams
from subterra_jax.tasks import TASKS, find
from subterra_jax.tunnel.plan import TunnelPlan


@dataclasses.dataclass(frozen=True)
class World:
    """A task in a tunnel.

    Attributes:
        env: The environment.
        params: The task.
        plan: The piece of tunnel that it happens in.
    """

    env: TunnelEnv
    params: EnvParams
    plan: TunnelPlan


def open_world(config: Recording) -> World:
    """The task and the tunnel of a recording.

    Raises:
        RecordingError: There is no such task, the tunnel is too short for it, or the cloud would not show all of it.
        TunnelError: The tunnel is missing or wrong.
    """
    name = find(config.task, short=True)
    if name not in TASKS:
        raise RecordingError(f"{name} cannot be recorded: the recorder drives robots on wheels")
    plan = st.load_tunnel(config.tunnel if config.scene is None else config.scene / "tunnel.npz")
    try:
        env, params = st.make(name, plan, config.lining)
    except ValueError as error:
        raise RecordingError(str(error)) from error
    unseen = [part for part in ("obstacles", "faults") if part in params.parts]
    if unseen and config.cloud != "none":
        raise RecordingError(f"the {config.cloud} sees none of the {unseen[0]} of {name}: leave out the cloud")
    piece = TASKS[name].piece
    if piece is not None:
        plan = plan.slice(piece[0], min(piece[1], plan.length - piece[0]))
    return World(env, params, plan)


def open_agent(config: Recording, world: World) -> Agent:
    """Who drives.

    Raises:
        SubterraError: There is no such agent or policy, or the policy does not fit the task.
    """
    if config.policy is None:
        return make_agent(config.agent, world.params)
    policy = load(config.policy)[0]
    check_fits(policy, dataclasses.replace(world.env, estimates=True), world.params, config.policy)
    return told(policy, world.params)


def draw(config: Recording, world: World) -> tuple[int, int | None]:
    """Seed and severity of the episode; None leaves the severity to the seed.

    Raises:
        EvaluationError: The list has no such episode.
    """
    if config.episode is None:
        return config.seed, None
    listed = listed_episodes(world.env, world.params, config.episode + 1)
    return int(listed.seed[-1]), int(listed.severity[-1])
