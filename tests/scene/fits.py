"""From points to cloud, axis, sections and bore: as the build makes them, or about an axis that a test knows."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from scene.bore import Bore
from scene.cleaning.clean import clean_cloud
from scene.cleaning.sort import Cleaned
from scene.cloud import Cloud, VoxelMean
from scene.errors import Cause
from scene.fitting.axis import CentrelineConfig
from scene.fitting.section import Sections, bore_from_sections, fit_sections
from scene.geometry import Axis, axis_through
from scene.writing.track import Track
from tests.recorded import check

TABLE = Path(__file__).with_name("values.csv")
TIGHT = 1e-5  # of a size: three cells of a section in 30,000 that are off by 30 cm


def keep(value: Any, part: str = "", rel: float = TIGHT) -> None:
    """Holds what the running test was given to what it was given before, `part` by part where there are several."""
    test = os.environ["PYTEST_CURRENT_TEST"].rpartition("::")[2].rpartition(" ")[0]
    check(TABLE, f"{test}{part}".replace(".", "_"), _own(value), rel)


def _own(value: Any) -> Any:
    """A value without what other parts of it give: frames of an axis, the standard of a track."""
    if isinstance(value, list | tuple):
        return [_own(one) for one in value]
    if isinstance(value, dict):
        return {name: _own(one) for name, one in value.items()}
    given = {"station", "tangent", "lateral", "up", "angle", "config"} if isinstance(value, Bore | Track) else set()
    parts = {name: one for name, one in vars(value).items() if name not in given and np.size(one)} if given else {}
    return parts or value


def told(result: Cleaned) -> dict[str, Any]:
    """Facts that cleaning gives of a cloud, and how many of its points have each cause."""
    count = {cause.name: int((result.cause == cause).sum()) for cause in Cause}
    names = ("start", "end", "points", "deepest")
    removed = [{name: getattr(part, name) for name in names} for part in result.removed]
    return {"axis": result.axis.position, "behind": result.behind, "removed": removed, **count}


def thin(points: np.ndarray, voxel: float = 0.04) -> Cloud:
    voxels = VoxelMean(voxel)
    voxels.add(points)
    return voxels.cloud()


def cleaned(cloud: Cloud) -> Cleaned:
    return clean_cloud(cloud, CentrelineConfig())


def axis_of(cloud: Cloud) -> Axis:
    return cleaned(cloud).axis


def bore_about(axis: Axis, cloud: Cloud) -> Bore:
    return bore_from_sections(axis, fit_sections(cloud, axis))


Line = tuple[np.ndarray, np.ndarray]  # first and last point of a straight axis in the frame of the input, m


def straight(cloud: Cloud, line: Line) -> Axis:
    first, last = np.asarray(line) - cloud.origin
    return axis_through(np.linspace(first, last, int(np.linalg.norm(last - first)) + 1), 1.0)


def fitted(cloud: Cloud, line: Line | None = None) -> tuple[Bore, Sections]:
    """Fitted to all of the cloud, whatever cleaning would have cut; about a line where it is known, in a third of
    the time, and else about the axis that cleaning finds."""
    axis = axis_of(cloud) if line is None else straight(cloud, line)
    sections = fit_sections(cloud, axis)
    return bore_from_sections(axis, sections), sections


def rebuilt(points: np.ndarray, line: Line | None = None) -> tuple[Bore, Cloud]:
    cloud = thin(points)
    return fitted(cloud, line)[0], cloud
