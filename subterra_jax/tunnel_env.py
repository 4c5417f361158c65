"""The environment of the planar tasks and of the walking robot: a motion, an ordered tuple of parts and one rule."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.actions import COMMAND, ESTIMATE, REPORT, action_bounds, check_action, read_report
from subterra_jax.compiled import compiled
from subterra_jax.env import Box, Info, Stepped
from subterra_jax.parts import Drive, Motion, Moved, Noise, Odometer, Part, PlanarLidar, SensingState, Step, Unicycle
from subterra_jax.parts.part import Batch, Bounds
from subterra_jax.parts.unicycle import clearance, in_contact, wrap
from subterra_jax.rows import vary_like
from subterra_jax.rules import Rule, Traverse, Verdict
from subterra_jax.state import EnvParams, State, make_alike
from subterra_jax.tunnel import Tunnel, at_station, foot

_NOTHING = Noise()


@dataclasses.dataclass(frozen=True)
class TunnelEnv:
    """A robot in a tunnel: a motion, parts (sensors, errors, obstacles) and the rule of a task.

    The observation holds 16 ranges (m; beam 0 straight ahead, the others counter-clockwise, evenly spaced), the
    odometer's distance (m) and heading (rad), then the entries of the rule and of further parts: `fields` names them.
    The action is forward speed (m/s) and yaw rate (rad/s). Where `action_size` is 4 or 5 there follow an estimate of
    the station (m) and the log of its standard deviation, and at 5 the direction faced (growing station: above 0); none
    of these moves the robot. An episode ends as its rule says, with failure at contact, and is truncated at the
    horizon.

    Attributes:
        id: Gymnasium id.
        rule: Rule of the task.
        parts: Parts in the order in which they act.
        motion: The part that moves the robot.
        estimates: The action holds an estimate, scored in `info`, even where the task asks for none.
    """

    id: str
    rule: Rule = dataclasses.field(default_factory=Traverse)
    parts: tuple[Part, ...] = (Odometer(), PlanarLidar())
    motion: Motion = dataclasses.field(default_factory=Unicycle)
    estimates: bool = False

    @compiled(in_haste=True)
    def reset(self, key: PRNGKeyArray, params: EnvParams) -> tuple[Float[Array, n_obs], State]:
        """Begin an episode.

        Args:
            key: Source of everything that is drawn for the episode, and of the first scan's noise.

        Returns:
            First observation and state.
        """
        start_key, scan_key = jax.random.split(key)
        state = self.begin(self.draw_reset(start_key, (), params), params)
        return self.observe(state, self.draw_step(scan_key, (), params), params), state

    @compiled(in_haste=True)
    def step(
        self, key: PRNGKeyArray, state: State, action: Float[Array, n_action], params: EnvParams
    ) -> tuple[Float[Array, n_obs], State, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Take one step, without a reset at its end: `AutoReset` resets.

        Args:
            action: Speed (m/s) and yaw rate (rad/s), and what `action_size` adds; clipped, NaN read as 0.

        Returns:
            Observation, state, reward, terminated, truncated and info. An episode that ends at the horizon with success
            or contact is terminated, not truncated.
        """
        noise = self.draw_step(key, (), params)
        state, reward, terminated, truncated, info = self.advance(state, action, noise, params)
        return self.observe(state, noise, params), state, reward, terminated, truncated, info

    def draw_reset(self, key: PRNGKeyArray, batch: Batch, params: EnvParams) -> dict[str, Any]:
        sources: dict[str, Any] = {part.name: part for part in (self.motion, *self.parts)} | {"rule": self.rule}
        streams = {name: source.random_streams() for name, source in sources.items()}
        numbers = [2, *(number for of_source in streams.values() for number in of_source)]
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.array(numbers, jnp.uint32))
        draws, first = {}, 1
        for name, source in sources.items():
            count = len(streams[name])
            own = keys[first] if count == 1 else keys[first : first + count]
            draws[name], first = source.draw_reset(own, batch, params), first + count
        if params.tunnel.count > 1:
            draws["tunnel"] = jax.random.uniform(keys[0], batch, jnp.float32)
        return draws

    def draw_step(self, key: PRNGKeyArray, batch: Batch, params: EnvParams) -> dict[str, Any]:
        """Draw the random numbers of one step of a batch; see `Env`. All parts share one call of each kind."""
        normals = {part.name: n for part in self.parts if (n := part.normals(params))}
        uniforms = {part.name: n for part in self.parts if (n := part.uniforms(params))}
        normal, uniform = {}, {}
        if normals:
            drawn = jax.random.normal(key, (*batch, sum(normals.values())), jnp.float32)
            normal = {name: drawn[..., where] for name, where in _slices(normals).items()}
        if uniforms:
            drawn = jax.random.uniform(jax.random.fold_in(key, 1), (*batch, sum(uniforms.values())), jnp.float32)
            uniform = {name: drawn[..., where] for name, where in _slices(uniforms).items()}
        noise: dict[str, Any] = {
            name: Noise(normal.get(name, ()), uniform.get(name, ())) for name in {**normals, **uniforms}
        }
        return {**noise, self.motion.name: self.motion.draw_step(jax.random.fold_in(key, 2), batch, params)}

    def begin(self, draws: Mapping[str, Any], params: EnvParams) -> State:
        """Make the state at the start of an episode, before any scan; `draws["choice"]` may hold a `Choice`."""
        index = jnp.zeros((), jnp.int32)
        if "tunnel" in draws:
            count = params.tunnel.count
            index = jnp.minimum((draws["tunnel"] * count).astype(jnp.int32), count - 1)
        tunnel = params.tunnel.pick(index)
        start = self.rule.start(draws["rule"], tunnel, params)
        if "choice" in draws:
            start = self.rule.place(start, draws["choice"])
        station = jnp.asarray(start.station, jnp.float32)
        x, y, tangent_x, tangent_y, _ = at_station(tunnel, station)
        heading = wrap(jnp.arctan2(tangent_y, tangent_x) + start.heading)
        state = State(
            position=jnp.stack([x - start.lateral * tangent_y, y + start.lateral * tangent_x]),
            heading=wrap(heading + jnp.pi * start.backwards),
            station=station,
            lateral=jnp.asarray(start.lateral, jnp.float32),
            furthest=station,
            command=jnp.zeros(2, jnp.float32),
            steps=jnp.zeros((), jnp.int32),
            tunnel=index,
            parts={"goal": start.own},
        )
        for part in (*self.parts, self.motion):
            own = part.begin(draws[part.name], state, params)
            state = dataclasses.replace(state, parts={**state.parts, part.name: own})
        return make_alike(state)

    def advance(
        self, state: State, action: Float[Array, n_action], noise: Mapping[str, Any], params: EnvParams
    ) -> Stepped:
        """Take one step but its observation: motion, contact, parts, reward and the end of the episode.

        Args:
            action: As for `step`.

        Returns:
            State, reward, terminated, truncated and info.

        Raises:
            ValueError: The action has another shape, seen when the step is traced.
        """
        action = check_action(action, self.action_size, self.id).astype(state.command.dtype)
        tunnel = params.tunnel.pick(state.tunnel)
        command = self.motion.obey(action, state, params)
        drive = Drive(command, command)
        for part in self.parts:
            drive = part.drive(state.parts[part.name], drive, state, params)
        moved = self.motion.move(state, drive, noise[self.motion.name], tunnel, params)
        place = foot(tunnel, moved.position, state.station)
        clear, contact = self._contact(state, moved, place.station, tunnel, params)
        step = Step(
            before=state,
            tunnel=tunnel,
            place=place,
            position=moved.position,
            heading=moved.heading,
            furthest=jnp.maximum(state.furthest, place.station),
            contact=contact | moved.fallen,
            command=command,
            drive=moved.drive,
            moved=jnp.abs(moved.drive.motion[0]) * jnp.asarray(params.vehicle.period),
            report=read_report(action, params),
            after={self.motion.name: moved.own},
        )
        step = self._advance_parts(step, noise, params)
        verdict = self.rule.judge(step, params)
        steps = state.steps + 1
        terminated = step.contact | verdict.ended
        info = self._info(step, moved, verdict, clear, contact)
        after = State(
            position=moved.position,
            heading=moved.heading,
            station=place.station,
            lateral=place.lateral,
            furthest=step.furthest,
            command=command,
            steps=steps,
            tunnel=state.tunnel,
            parts={**step.after, "goal": verdict.own},
        )
        reward = sum(verdict.terms.values(), jnp.zeros_like(place.station))
        return vary_like(after), reward, terminated, (steps >= params.horizon) & ~terminated, info

    def observe(
        self, state: State, noise: Mapping[str, Any], params: EnvParams, needed: Any = True
    ) -> Float[Array, n_obs]:
        """Observe a state.

        Args:
            needed: Someone will read the observation; where not, ranges may be anything.

        Returns:
            Noisy ranges (m), dead-reckoned distance (m) and heading (rad), then the further entries of `fields`.
        """
        tunnel = params.tunnel.pick(state.tunnel)
        sensing = self._sensing(state, noise, tunnel, params, needed)
        entries: dict[str, Array] = {}
        for source in self._observers():
            if isinstance(source, Rule):
                entries |= source.observe(state, tunnel)
            else:
                own, of_part = state.parts[source.name], noise.get(source.name, _NOTHING)
                entries |= source.observe(own, sensing, of_part, params)
        return jnp.concatenate([jnp.atleast_1d(entry) for entry in entries.values()])

    def skips_unneeded(self, params: EnvParams) -> bool:
        return any(part.skips_unneeded(params) for part in self.parts)

    @property
    def action_size(self) -> int:
        """Count of numbers in one action."""
        return REPORT if self.rule.reports else ESTIMATE if self.estimates else COMMAND

    def observation_size(self, params: EnvParams) -> int:
        return sum(jnp.size(low) for low, _ in self._space(params).values())

    def fields(self, params: EnvParams) -> dict[str, slice]:
        """Return the place of each named entry in an observation."""
        return _slices({name: jnp.size(low) for name, (low, _) in self._space(params).items()})

    def observation_space(self, params: EnvParams) -> Box:
        bounds = self._space(params).values()
        low, high = (np.concatenate([np.ravel(np.asarray(bound[side])) for bound in bounds]) for side in (0, 1))
        return Box(low.astype(np.float32), high.astype(np.float32))

    def images(self, params: EnvParams) -> dict[str, tuple[int, int]]:
        """Return rows and columns of the named entries that are images; in an observation they lie row by row."""
        return {name: shape for part in self.parts for name, shape in part.images(params).items()}

    def action_space(self, params: EnvParams) -> Box:
        """Return the bounds of an action; `step` clips to them."""
        return action_bounds(self.action_size, params)

    def privileged(self, state: State, params: EnvParams) -> dict[str, Float[Array, ""]]:
        """Return what only a teacher or a critic may know; no observation holds any of it.

        Returns:
            Station and lateral offset (m), offset over half-width, sine and cosine of the heading against the axis, and
            what parts and rule add: the odometer's biases, slip, severity, way to the goal.
        """
        _, _, tangent_x, tangent_y, half_width = at_station(params.tunnel.pick(state.tunnel), state.station)
        cos, sin = jnp.cos(state.heading), jnp.sin(state.heading)
        known = {
            "station": state.station,
            "lateral": state.lateral,
            "offset": state.lateral / half_width,
            "heading_sin": sin * tangent_x - cos * tangent_y,
            "heading_cos": cos * tangent_x + sin * tangent_y,
        }
        for part in self.parts:
            known |= part.privileged(state.parts[part.name])
        return known | self.rule.privileged(state)

    def levels(self, params: EnvParams) -> range:
        """Return the levels of difficulty that an evaluation goes through evenly; just 0 in most tasks."""
        return next((levels for part in self.parts if (levels := part.levels(params))), range(1))

    def at_level(self, params: EnvParams, level: Any) -> EnvParams:
        for part in self.parts:
            params = part.at_level(params, level)
        return params

    def boxes(self, state: State, params: EnvParams) -> list[Any]:
        """Return the boxes near the robot, for pictures: a list of `parts.part.Boxes`."""
        tunnel = params.tunnel.pick(state.tunnel)
        return [b for part in self.parts for b in part.boxes(state.parts[part.name], state.station, tunnel, params)]

    def _observers(self) -> list[Part | Rule]:
        """Parts and rule in the order of their entries in the observation."""
        first = [part for part in sorted(self.parts, key=lambda part: part.place) if part.place < 2]
        return [*first, self.rule, *(part for part in self.parts if part.place >= 2)]

    def _space(self, params: EnvParams) -> dict[str, Bounds]:
        space: dict[str, Bounds] = {}
        owner: dict[str, str] = {}
        for source in self._observers():
            who = f"the rule {type(source).__name__}" if isinstance(source, Rule) else f"the part {source.name!r}"
            for name, bounds in source.space(params).items():
                if name in space:
                    raise ValueError(f"{self.id}: both {owner[name]} and {who} observe {name!r}")
                space[name], owner[name] = bounds, who
        return space

    def _contact(
        self, state: State, moved: Moved, station: Array, tunnel: Tunnel, params: EnvParams
    ) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """Distance to the nearest wall or obstacle, m, exact up to 0.8 m; and whether the robot touches one."""
        beside: Any = np.inf
        for part in self.parts:
            gap = part.clearance(state.parts[part.name], moved.position, station, tunnel, params)
            beside = jnp.minimum(beside, gap)
        if not self.motion.on_the_plan:
            return jnp.minimum(moved.clearance, beside), moved.contact | (beside < params.vehicle.radius)
        clear = jnp.minimum(clearance(tunnel, moved.position, station), beside)
        return clear, in_contact(tunnel, clear, station, params.vehicle)

    def _advance_parts(self, step: Step, noise: Mapping[str, Any], params: EnvParams) -> Step:
        """Advance every part in turn; each sees the states of those before it."""
        for part in self.parts:
            own = part.advance(step.before.parts[part.name], step, noise.get(part.name, _NOTHING), params)
            step = dataclasses.replace(step, after={**step.after, part.name: own})
        return step

    def _sensing(
        self, state: State, noise: Mapping[str, Any], tunnel: Tunnel, params: EnvParams, needed: Any
    ) -> SensingState:
        """The state that sensors show, and the obstacles and faults between them and the walls."""
        sensing = SensingState(tunnel, state.position, state.heading, state.station, state.parts, needed)
        for part in self.parts:
            sensing = part.look_from(state.parts[part.name], sensing, params)

        def hits(directions: Array) -> Any:
            nearest: Any = np.inf
            for part in self.parts:
                nearest = jnp.minimum(nearest, part.hits(state.parts[part.name], sensing, directions, params))
            return nearest

        def corrupt(ranges: Array) -> Array:
            for part in self.parts:
                own, of_part = state.parts[part.name], noise.get(part.name, _NOTHING)
                ranges = part.corrupt(own, ranges, of_part, params)
            return ranges

        return dataclasses.replace(sensing, hits=hits, corrupt=corrupt)

    def _info(
        self, step: Step, moved: Moved, verdict: Verdict, clear: Float[Array, ""], contact: Bool[Array, ""]
    ) -> Info:
        """Entries of `info`: those of rule, motion, estimate, environment and parts, in this order."""
        info = {**verdict.terms, **verdict.info, **moved.info}
        if self.action_size > COMMAND:
            info["estimate_error"] = step.report[0] - step.place.station
            info["estimate_log_sigma"] = step.report[1]
        info |= {
            "coverage": jnp.clip(step.furthest / step.tunnel.length, 0.0, 1.0),
            "station": step.place.station,
            "lateral": step.place.lateral,
            "half_width": step.place.half_width,
            "clearance": clear,
            "contact": contact,
            "success": verdict.success & ~jnp.asarray(moved.fallen),
        }
        for part in self.parts:
            info |= part.info(step.before.parts[part.name])
        return info


def _slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Places of named pieces that stand one after another."""
    ends = np.cumsum(list(sizes.values())).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}
