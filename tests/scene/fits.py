"""From points to cloud, axis, sections and bore, as the build makes them."""

import numpy as np

from scene.bore import Bore
from scene.cleaning.clean import CleaningConfig, clean_cloud
from scene.cleaning.removed import Cleaned
from scene.cloud import Cloud, VoxelMean
from scene.fitting.assemble import bore_from_sections
from scene.fitting.centreline import CentrelineConfig
from scene.fitting.section import Sections, fit_sections
from scene.geometry import Axis


def thin(points: np.ndarray, voxel: float = 0.04) -> Cloud:
    voxels = VoxelMean(voxel)
    voxels.add(points)
    return voxels.cloud()


def cleaned(cloud: Cloud, strict: bool = False) -> Cleaned:
    return clean_cloud(cloud, CleaningConfig(strict), CentrelineConfig())


def axis_of(cloud: Cloud) -> Axis:
    return cleaned(cloud).axis


def bore_about(axis: Axis, cloud: Cloud) -> Bore:
    return bore_from_sections(axis, fit_sections(cloud, axis))


def fitted(cloud: Cloud) -> tuple[Bore, Sections]:
    """Fitted to all of the cloud, whatever cleaning would have cut."""
    axis = axis_of(cloud)
    sections = fit_sections(cloud, axis)
    return bore_from_sections(axis, sections), sections


def rebuilt(points: np.ndarray) -> tuple[Bore, Cloud]:
    cloud = thin(points)
    return fitted(cloud)[0], cloud
