"""The contract of a rule: what a task asks, how its episodes start, when they end and what they are worth."""

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax import constants
from subterra_jax.parts.part import Batch, Bounds, Keys, Step
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel

Terms = dict[str, Float[Array, ""]]
GOAL_KINDS = ("cover", "stop", "return", "report")


@struct.dataclass
class StartParams:
    """Start of an episode.

    Attributes:
        station: Station of the start as agents believe it, m; 0 is the mouth.
        lateral: Largest offset from the centreline to either side, m; drawn uniformly.
        heading: Largest angle to the centreline to either side, rad; drawn uniformly.
        station_sigma: Standard deviation of the true start about `station`, m, cut off at three of them. Only tasks
            with a goal draw it; the odometer reads 0 there all the same.
    """

    station: float = 0.0
    lateral: float = constants.START_LATERAL
    heading: float = constants.START_HEADING
    station_sigma: float = 0.0


@dataclasses.dataclass(frozen=True)
class Start:
    """A start.

    Attributes:
        station: Station, m.
        lateral: Distance to the left of the centreline, m.
        heading: Angle to the centreline, rad.
        backwards: 0 for a robot that faces growing stations, 1 for the other way.
        own: State of the rule, any pytree of arrays.
    """

    station: Any
    lateral: Any = 0.0
    heading: Any = 0.0
    backwards: Any = 0.0
    own: Any = ()


class Choice(NamedTuple):
    """A start and a goal chosen by the caller in place of drawn ones; NaN leaves what was drawn."""

    station: Any = jnp.nan  # station of the start, m
    lateral: Any = jnp.nan  # distance of the start to the left of the centreline, m
    heading: Any = jnp.nan  # angle of the start to the centreline, rad; 0 faces growing stations
    goal: Any = jnp.nan  # station of the goal, m


@dataclasses.dataclass(frozen=True)
class Verdict:
    """A rule's judgement of a step.

    Attributes:
        success: The task was achieved at this step.
        ended: The episode is over for good, for a reason other than contact.
        terms: Terms of the reward by name, each beginning with `reward_`; the reward is their sum.
        own: State of the rule afterwards.
        info: Further entries of `info`.
    """

    success: Bool[Array, ""]
    ended: Bool[Array, ""]
    terms: Terms
    own: Any = ()
    info: dict[str, Array] = dataclasses.field(default_factory=dict)


class Rule(abc.ABC):
    """The rule of one task: static and hashable, a frozen dataclass without state of its own.

    Its state is the entry `goal` of `State.parts`, its params are entries of `EnvParams.parts`.

    Attributes:
        key: Name of the rule in the digest of the constants, where a rename of the class leaves it; by default the
            class's name.
        goal_kind: What agents are asked to do: `cover` (drive on), `stop` (at the observed `goal`), `return` (to the
            start once the observed `flag` is raised) or `report` (stop and say where).
        reports: The action holds an estimate that counts.
        covers: Success is coverage. An evaluation then drives on after success, and counts how far the robot comes.
        needs: Names of the parts that the rule cannot do without.
        streams: Numbers of its random streams at a reset, one key each.
    """

    key: ClassVar[str]
    goal_kind: ClassVar[str] = "cover"
    reports: ClassVar[bool] = False
    covers: ClassVar[bool] = False
    needs: ClassVar[tuple[str, ...]] = ()
    streams: ClassVar[tuple[int, ...]] = (0,)

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        if "key" not in cls.__dict__:
            cls.key = cls.__name__

    def defaults(self) -> dict[str, Any]:
        """Entries of `EnvParams` that the rule reads, by name, with their default values; `start` at least."""
        return {"start": StartParams()}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> Any:
        """Draw what a start needs, for a whole batch at once; by default two numbers in [-1, 1] for `spread`."""
        return jax.random.uniform(key, (*batch, 2), jnp.float32, minval=-1.0)

    def start(self, draw: Any, tunnel: Tunnel, params: EnvParams) -> Start:
        """Choose the start of an episode; by default `params.start`, facing growing stations."""
        return Start(jnp.asarray(params.start.station, jnp.float32), **spread(draw, params))

    def place(self, start: Start, choice: Choice) -> Start:
        """Return a start with what a caller has chosen; rules whose state depends on the start bring it along."""
        return dataclasses.replace(
            start,
            station=chosen(choice.station, start.station),
            lateral=chosen(choice.lateral, start.lateral),
            heading=chosen(choice.heading, start.heading),
            backwards=jnp.where(jnp.isnan(choice.heading), start.backwards, 0.0),
        )

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        """Names and bounds of the numbers that the rule adds to the observation."""
        return {}

    def observe(self, state: State, tunnel: Tunnel) -> dict[str, Array]:
        """Return those numbers, in the order of `space`."""
        return {}

    @abc.abstractmethod
    def judge(self, step: Step, params: EnvParams) -> Verdict:
        """Judge a step: success, end, reward."""

    def privileged(self, state: State) -> dict[str, Array]:
        """Return what a teacher or a critic may know of the rule's state, and an agent may not."""
        return {}

    def tolerance(self, params: EnvParams) -> Any:
        """Return the error up to which an estimate of the station counts as right, m."""
        return constants.TOLERANCE

    def shortest_way(self, state: State, tunnel: Tunnel, params: EnvParams) -> Any:
        """Return the length of the shortest way from the start to success, m; NaN where there is no such thing."""
        return jnp.nan

    def least_length(self, params: EnvParams) -> float:
        """Return the length of the shortest tunnel that has room for the task, m."""
        return 0.0

    @classmethod
    def random_streams(cls) -> tuple[int, ...]:
        """Return the numbers of the rule's random streams."""
        return cls.streams


def chosen(choice: Any, drawn: Any) -> Array:
    """Return a caller's choice, or what was drawn where that is NaN."""
    return jnp.where(jnp.isnan(choice), drawn, choice)


def spread(draw: Float[Array, "2"], params: EnvParams) -> dict[str, Array]:
    """Offset and angle of a start, from two numbers in [-1, 1] and `params.start`."""
    return {"lateral": params.start.lateral * draw[0], "heading": params.start.heading * draw[1]}


def jerk(command: Float[Array, "2"], previous: Float[Array, "2"]) -> Float[Array, ""]:
    """Return the change of the command in a step, m/s and rad/s alike."""
    change = jnp.abs(command - previous)
    return change[0] + change[1]
