"""One record for each episode that was driven."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from subterra_jax.env import TunnelEnv
from subterra_jax.evaluation.episodes import Episodes
from subterra_jax.state import EnvParams


@dataclasses.dataclass(frozen=True)
class Records:
    """What came of `n` episodes; NaN where a quantity does not apply, as estimates of one who makes none.

    Attributes:
        seed: Seed of the episode.
        tunnel: Which tunnel of a stack.
        severity: Severity of the faults.
        group: Stratum of the bootstrap.
        success: Whether the task was achieved.
        contact: Whether it ended at a wall or an obstacle.
        coverage: Share of the tunnel covered, as the paper counts it: the episode ends at the goal's share.
        progress: The same, had the agent gone on to the far mouth: not cut off at success.
        spl: Success weighted by path length, 0 to 1.
        travelled: Distance driven, m.
        contacts_per_100m: Contacts for each 100 m driven.
        clearance: Least distance from the robot's middle to wall or obstacle, m; 0.8 where it was never nearer.
        offset: Mean |d| / w.
        lateral: Root mean square distance from the centreline, m.
        time: Duration, s.
        jerk: Mean |Δv| + |Δω| of a step, m/s and rad/s.
        goal_error: Station at the end less the one asked for, m; of a report, report less truth.
        axial_final: Last error of the estimated station, m.
        axial_rms: Root mean square error of the estimated station, m.
        drift: |axial_final| in % of the distance driven.
        time_to_lock: Time from which the estimate stayed within the task's tolerance (1 m where it has none), s; NaN
            where it was not within it at the end.
        cycle_slips: Rings by which the estimate slipped; NaN where the lining has no rings.
        crps: Mean continuous ranked probability score of the estimate, m.
        nees: Mean squared error over claimed variance; 1 from one who knows how well it knows.

    Source: SPL is Anderson et al. 2018, On Evaluation of Embodied Navigation Agents.
    """

    seed: Int[np.ndarray, " n"]
    tunnel: Int[np.ndarray, " n"]
    severity: Int[np.ndarray, " n"]
    group: Int[np.ndarray, " n"]
    success: Bool[np.ndarray, " n"]
    contact: Bool[np.ndarray, " n"]
    coverage: Float[np.ndarray, " n"]
    progress: Float[np.ndarray, " n"]
    spl: Float[np.ndarray, " n"]
    travelled: Float[np.ndarray, " n"]
    contacts_per_100m: Float[np.ndarray, " n"]
    clearance: Float[np.ndarray, " n"]
    offset: Float[np.ndarray, " n"]
    lateral: Float[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]
    jerk: Float[np.ndarray, " n"]
    goal_error: Float[np.ndarray, " n"]
    axial_final: Float[np.ndarray, " n"]
    axial_rms: Float[np.ndarray, " n"]
    drift: Float[np.ndarray, " n"]
    time_to_lock: Float[np.ndarray, " n"]
    cycle_slips: Float[np.ndarray, " n"]
    crps: Float[np.ndarray, " n"]
    nees: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.seed)

    def where(self, chosen: Bool[np.ndarray, " n"]) -> "Records":
        """The records of some episodes."""
        return Records(**{field.name: getattr(self, field.name)[chosen] for field in dataclasses.fields(self)})

    def as_columns(self) -> dict[str, list[Any]]:
        """Plain lists by name, for JSON; NaN is None."""

        def plain(values: np.ndarray) -> list[Any]:
            if values.dtype.kind != "f":
                return values.tolist()
            return [None if np.isnan(value) else value for value in values.tolist()]

        return {field.name: plain(getattr(self, field.name)) for field in dataclasses.fields(self)}

    @classmethod
    def from_columns(cls, columns: dict[str, list[Any]]) -> "Records":
        """The inverse of `as_columns`."""
        kinds = {"success": bool, "contact": bool, "seed": np.uint32, "tunnel": int, "severity": int, "group": int}
        return cls(**{name: np.array(values, kinds.get(name, float)) for name, values in columns.items()})


def finished(tally: Any, episodes: Episodes, env: TunnelEnv, params: EnvParams) -> Records:
    """Make records of the `Tally` of finished episodes, fetched to the host."""
    steps, period = np.maximum(tally.steps, 1), float(np.max(params.vehicle.period))
    travelled, found = tally.travelled.astype(float), tally.estimates
    per_metre = _over(np.ones(len(episodes)), travelled)
    pitch = np.broadcast_to(np.asarray(params.tunnel.ring_pitch), params.tunnel.count)[episodes.tunnel]
    covers = env.rule.errand == "cover"
    error = found.error.astype(float)
    estimated = ~np.isnan(found.square)
    locked = estimated & (found.unlocked < tally.steps)
    nothing = np.full(len(episodes), np.nan)
    return Records(
        **dataclasses.asdict(episodes),
        success=tally.success,
        contact=tally.contact,
        coverage=tally.coverage.astype(float) if covers else nothing,
        progress=tally.progress.astype(float) if covers else nothing,
        spl=np.where(np.isnan(tally.way), np.nan, tally.success * _over(tally.way, np.maximum(tally.way, travelled))),
        travelled=travelled,
        contacts_per_100m=100.0 * tally.contact * per_metre,
        clearance=tally.clearance.astype(float),
        offset=tally.offset / steps,
        lateral=np.sqrt(tally.lateral_square / steps),
        time=tally.steps * period,
        jerk=tally.jerk / steps,
        goal_error=tally.goal_error.astype(float),
        axial_final=np.where(estimated, error, np.nan),
        axial_rms=np.sqrt(found.square / steps),
        drift=100.0 * np.abs(np.where(estimated, error, np.nan)) * per_metre,
        time_to_lock=np.where(locked, found.unlocked * period, np.nan),
        cycle_slips=np.where(estimated & (pitch > 0.0), found.slips, np.nan),
        crps=found.crps / steps,
        nees=found.nees / steps,
    )


def _over(value: np.ndarray, divisor: np.ndarray) -> np.ndarray:
    """A ratio; NaN where one would divide by 0."""
    return np.where(divisor > 0.0, value / np.where(divisor > 0.0, divisor, 1.0), np.nan)
