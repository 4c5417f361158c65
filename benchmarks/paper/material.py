"""What figures 1 to 3 are drawn from, each read when first asked for and then kept."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from benchmarks.fidelity.candidate import load
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import paired
from benchmarks.fidelity.references import HoldConfig, load_hold
from benchmarks.figures import scene_points
from benchmarks.paper.camera import Pose, picture
from benchmarks.paper.errors import PaperError
from benchmarks.paper.recorded import Frame, Place, load_frame
from benchmarks.paper.steps import SCENE_FILES, SURVEY_FILES, require

_PLACE = 0.3  # of the bore's length: what lies ahead there fills the frame
_RADIUS = 8.0  # m about it, where the frame may be taken
_DURATION = 1.5  # s of a frame: the Avia's pattern has closed most of its gaps by then
_FOV = np.deg2rad(58.0)  # with 4:3 inside the Avia's 70 by 77 degrees
_OS1_SIGMA = 0.03  # m, data sheet


@dataclass(frozen=True)
class Material:
    """A survey and the scene built from its Avia, with the OS1 held out.

    Attributes:
        survey: Folder with `survey.bag`, `survey_os1.bag` and a trajectory for each.
        scene: Scene folder.
    """

    survey: Path
    scene: Path

    def check(self) -> None:
        """Raises `PaperError` naming the first file that is missing."""
        require(self.survey, SURVEY_FILES)
        require(self.scene, SCENE_FILES)

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """Of the scene."""
        path = self.scene / "manifest.json"
        try:
            return dict(json.loads(path.read_text()))
        except (OSError, ValueError) as error:
            raise PaperError(f"{path}: is no manifest ({error})") from error

    @property
    def simulated(self) -> bool:
        """Whether the survey is."""
        return self.manifest.get("input_provenance") == "simulated"

    @cached_property
    def case(self) -> Case:
        """The scene with the held-out OS1."""
        candidate = load(self.scene)
        config = HoldConfig(scan_spacing=0.5, sigma=_OS1_SIGMA)
        held_out = (self.survey / "survey_os1.bag", self.survey / "groundtruth_os1.tum")
        return Case(candidate, load_hold(*held_out, candidate.origin, config))

    @cached_property
    def residual(self) -> Float[np.ndarray, " k"]:
        """Range in the scene less held-out range, of every held-out beam that meets the scene, m."""
        pairs = paired(self.case)
        return pairs.difference[pairs.hit]

    @cached_property
    def row(self) -> int:
        """The section of the bore where the frame was taken."""
        return round(_PLACE * (len(self.case.candidate.bore.station) - 1))

    @cached_property
    def frame(self) -> Frame:
        """A moment of the recording that the builder read."""
        candidate = self.case.candidate
        place = Place(candidate.bore.position[self.row], candidate.bore.tangent[self.row], _RADIUS)
        return load_frame(
            self.survey / "survey.bag", self.survey / "groundtruth.tum", candidate.origin, place, _DURATION
        )

    @cached_property
    def pose(self) -> Pose:
        """From the LiDAR along the bore, the way that it looks."""
        frame, bore = self.frame, self.case.candidate.bore
        tangent = bore.tangent[np.argmin(np.linalg.norm(bore.position - frame.at, axis=1))]
        ahead = tangent * np.sign(((frame.points - frame.origin) @ tangent).mean() or 1.0)
        return Pose(frame.at, ahead, float(_FOV), 1400, 1050)

    @cached_property
    def view(self) -> UInt8[np.ndarray, "height width 3"]:
        """The scene as MuJoCo renders it from there."""
        return picture(self.scene / "scene.xml", self.pose)

    @cached_property
    def wall(self) -> UInt8[np.ndarray, "height width 3"]:
        """The lining and the foot of the wall at the same place, closer by."""
        bore = self.case.candidate.bore
        ahead = 0.5 * bore.tangent[self.row] + 0.85 * bore.lateral[self.row]
        return picture(self.scene / "scene.xml", Pose(self.pose.at, ahead / np.linalg.norm(ahead), 1.0, 700, 700))

    @cached_property
    def cloud(self) -> Float[np.ndarray, "p 3"]:
        """The registered cloud, thinned, tunnel frame, m."""
        return scene_points(self.scene)


def read_truth(survey: Path) -> dict[str, Any]:
    """How a simulated survey was asked for; empty where its `truth.json` does not say."""
    try:
        return dict(json.loads((survey / "truth.json").read_text())["config"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}
