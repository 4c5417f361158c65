"""Rail seats of the candidate: what lies upon what, measured by vertical rays."""

import numpy as np
import trimesh
from jaxtyping import Float

from benchmarks.fidelity.case import Case, derived
from benchmarks.fidelity.compiled import concatenated, geom_mesh
from benchmarks.fidelity.derive import released
from benchmarks.fidelity.derive.curve import candidate_curve
from benchmarks.fidelity.derive.released import of_released
from benchmarks.fidelity.derive.surface import Caster

_HEAD_HALF = 0.0365  # m from a head's inner face to its middle
_FAR = 1.0  # m
_ASIDE = 0.3  # m from the track's middle, where the bed is looked for


@derived
def mismatches(case: Case) -> Float[np.ndarray, " k"]:
    """Overlaps (below 0) and gaps (above) of pad on sleeper, rail on pad, and of sleepers that hang over the bed, m.

    Raises:
        ValueError: There is no track.
    """
    track, curve = case.candidate.track, candidate_curve(case)
    if not len(track.sleeper) or min(len(rail) for rail in track.rail.values()) < 2:
        raise ValueError("there is no track")
    sleepers, rails, pads = (Caster(m) for m in (track.sleeper_mesh, track.rail_mesh, track.fastening_mesh))
    at = curve.local(track.sleeper)
    _, _, left, up = curve.frames(at[:, 0])
    found = []
    for rail in track.rail.values():
        face = curve.local(rail)
        face = face[np.argsort(face[:, 0])]
        inner = np.interp(at[:, 0], face[:, 0], face[:, 1])
        across = inner + np.sign(inner - at[:, 1]) * _HEAD_HALF
        seat = track.sleeper + (across - at[:, 1])[:, None] * left
        top = _level(sleepers, seat, up, above=True)
        pad = _level(pads, seat, up, above=False), _level(pads, seat, up, above=True)
        foot = _level(rails, seat, up, above=False)
        found += [pad[0] - top, foot - np.where(np.isfinite(pad[1]), pad[1], top)]
    found.append(np.maximum(_hanging(case, sleepers, track.sleeper, left, up), 0.0))
    every = np.concatenate(found)
    return every[np.isfinite(every)]


def _level(caster: Caster, at: np.ndarray, up: np.ndarray, above: bool) -> Float[np.ndarray, " k"]:
    """Height about `at` of the first surface met from far above or from far below, m; `nan` for none."""
    sign = 1.0 if above else -1.0
    reach = caster.first(at + sign * _FAR * up, -sign * up)[0]
    return np.where(np.isfinite(reach), sign * (_FAR - reach), np.nan)


def _hanging(case: Case, sleepers: Caster, at: np.ndarray, left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """How far the bottom of each sleeper is above the bed, or its top below it, m."""
    place = at + _ASIDE * left
    bed = Caster(concatenated([case.candidate.lining, *_beds(case)]))
    # From just above the sleeper: the lining overhead is out of the way.
    level = 0.3 - bed.first(place + 0.3 * up, -up)[0]
    bottom, top = _level(sleepers, place, up, above=False), _level(sleepers, place, up, above=True)
    return np.maximum(bottom - level, level - top)


def _beds(case: Case) -> list[trimesh.Trimesh]:
    """Slabs of the released scene on which sleepers lie; none where there is no scene."""
    return _slabs(case) if case.candidate.scene.exists() else []


@of_released("scene")
def _slabs(case: Case) -> list[trimesh.Trimesh]:
    model = released.model(case)
    data = released.placed(model)
    return [geom_mesh(model, data, k) for k in range(model.ngeom) if model.geom(k).name.startswith("bed_")]
