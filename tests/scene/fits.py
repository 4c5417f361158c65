"""From a cloud to its axis, sections and bore, as the build makes them."""

from scene.bore import Axis, Bore
from scene.cleaning.clean import CleaningConfig, clean_cloud
from scene.cloud import Cloud
from scene.fitting.assemble import bore_from_sections
from scene.fitting.centreline import CentrelineConfig
from scene.fitting.section import Sections, fit_sections


def axis_of(cloud: Cloud) -> Axis:
    return clean_cloud(cloud, CleaningConfig(), CentrelineConfig()).axis


def fitted(cloud: Cloud) -> tuple[Bore, Sections]:
    """Fitted to all of the cloud, whatever cleaning would have cut."""
    axis = axis_of(cloud)
    sections = fit_sections(cloud, axis)
    return bore_from_sections(axis, sections), sections
