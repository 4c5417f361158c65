"""Controls that spoil what the reconstruction is judged against, and cheats."""

from dataclasses import replace
from hashlib import sha256

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls.warp import moved_references
from benchmarks.fidelity.derive.surface import Caster, visible
from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.references import Hold


def extrinsic_wrong(case: Case, angle: float) -> Case:
    """Beams of the held-out recording turned about each sensor's own vertical and side axis, rad."""
    hold = _needed(case)
    turn = Rotation.from_euler("zy", [angle, angle]).as_matrix()
    return replace(case, hold=replace(hold, direction=hold.direction @ turn.T, cache={}), cache={})


def poses_permuted(case: Case, rng: np.random.Generator) -> Case:
    """Every scan at the place of another."""
    hold = _needed(case)
    scans, first, index = np.unique(hold.scan, return_index=True, return_inverse=True)
    place = hold.origin[first][rng.permutation(len(scans))]
    return replace(
        case, hold=replace(hold, origin=hold.origin - hold.origin[first][index] + place[index], cache={}), cache={}
    )


def foreign(case: Case, other: Candidate) -> Case:
    """Another tunnel judged by this one's references, brought to begin at its mouth in its direction."""
    here, there = case.candidate.bore, other.bore
    turn = _yaw(there.tangent[0]) @ _yaw(here.tangent[0]).T
    shift = there.position[0] - turn @ here.position[0]
    return replace(moved_references(case, turn, shift), candidate=other)


def sampled_from_mesh(case: Case, sigma: float, rng: np.random.Generator) -> Case:
    """The recording replaced by beams cast in the candidate itself, with range noise or without."""
    hold = _needed(case)
    reach, _ = Caster(visible(case.candidate)).first(hold.origin, hold.direction)
    reach = reach + rng.normal(0.0, 1.0, len(reach)) * sigma
    forged = sha256(reach.tobytes()).hexdigest()
    keep = np.isfinite(reach)
    columns = {name: getattr(hold, name)[keep] for name in ("time", "scan", "origin", "direction")}
    return replace(case, hold=replace(hold, **columns, range=reach[keep], hash=forged, cache={}), cache={})


def builder_read_hold(case: Case) -> Case:
    """A builder that had the held-out recording: the manifest's inputs hold its hash, and the fit is the hold."""
    hold = _needed(case)
    manifest = dict(case.candidate.manifest)
    manifest["inputs"] = [*manifest.get("inputs", []), {"file": "hold", "sha256": hold.hash}]
    return replace(case, candidate=replace(case.candidate, manifest=manifest), fit=hold, cache={})


def _needed(case: Case) -> Hold:
    if case.hold is None:
        raise FidelityError("this control needs a held-out recording, give one with --recording and --trajectory")
    return case.hold


def _yaw(tangent: np.ndarray) -> np.ndarray:
    return Rotation.from_euler("z", np.arctan2(tangent[1], tangent[0])).as_matrix()
