"""What the pipeline hands from fitting to judging and writing."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from scene.bore import Bore
from scene.cleaning.removed import Removed
from scene.cloud import Cloud
from scene.fitting.trackseen import SeenTrack
from scene.poses.trajectory import Trajectory


@dataclass(frozen=True)
class Reconstruction:
    """A bore, and all that the manifest says about it."""

    bore: Bore  # Bore in the tunnel frame
    origin: np.ndarray  # Origin of the tunnel frame in the input's, whole metres
    inputs: list[dict[str, Any]]  # Name, size and hash of each
    facts: dict[str, Any]  # Facts for the manifest
    provenance: dict[str, str]  # Provenance of lining features, for the manifest
    odometry: Trajectory | None = None  # The estimated poses, where there was no trajectory to be given
    cloud: Cloud | None = None  # The bore's part of the registered cloud, where there was one
    everything: Cloud | None = None  # The registered cloud before cleaning
    removed: tuple[Removed, ...] = ()  # What cleaning cut away, by station of the bore, m
    cause: np.ndarray | None = None  # `scene.cleaning.removed.Cause` of each point of `everything`, `(n,)`
    seen: SeenTrack = field(default_factory=SeenTrack)  # Tracks that the cloud shows
