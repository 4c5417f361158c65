"""What every way to find the poses hands back, and the odometry that most of them need."""

from dataclasses import dataclass
from typing import Any

from scene.cli import Stages
from scene.poses.odometry import Odometry, estimate_odometry
from scene.poses.odometrylog import OdometryLog
from scene.poses.tracker import Guide
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording
from scene.resume import Partial


@dataclass(frozen=True)
class Located:
    """Where the LiDAR was, and what the manifest says of it.

    Attributes:
        trajectory: Poses of the LiDAR; in the control's frame where there was one, else level from the first sweep.
        estimated: Whether the poses were found here, so that they are worth writing down.
        most_uncovered: Share of the scans that may lie outside the trajectory's time.
        facts: `poses`, `length_fixed_by`, `length_uncertainty` (m, 95 %, or `None` where nobody can say) and figures.
    """

    trajectory: Trajectory
    facts: dict[str, Any]
    estimated: bool = True
    most_uncovered: float = 0.05


def track(
    recording: Recording, guide: Guide | None, progress: Stages, partial: Partial, turn: str = "first"
) -> Odometry:
    """LiDAR odometry among the stages and the partial results of a build."""
    stage = progress.start(f"LiDAR odometry, {turn} pass", recording.scan_count)
    return estimate_odometry(recording, guide, stage, OdometryLog(partial, f"odometry-{turn}"))
