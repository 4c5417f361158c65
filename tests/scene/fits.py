"""From points to cloud, axis, sections and bore: as the build makes them, or about an axis that a test knows."""

import numpy as np

from scene.bore import Bore
from scene.cleaning.clean import clean_cloud
from scene.cleaning.sort import Cleaned
from scene.cloud import Cloud, VoxelMean
from scene.fitting.axis import CentrelineConfig
from scene.fitting.section import Sections, bore_from_sections, fit_sections
from scene.geometry import Axis, axis_through


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
