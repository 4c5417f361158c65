"""The leak detector: a builder must not know what it is judged by, and that must not come from the builder's mesh."""

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.references import Hold
from benchmarks.fidelity.registry import Value

NOISE_BAND = (0.5, 3.0)  # times the sensor's stated sigma
MEDIAN_FLOOR = 0.5  # of the recording's own noise; the median distance to the mesh must not be smaller
PATCH_NEIGHBOURS = 12
PATCH_RADIUS = 0.25  # m within which neighbours must lie to make a plane
PATCH_SAMPLES = 8_000


def find_leaks(case: Case, values: dict[str, Value], recorded: str | None = None) -> list[str]:
    """Return the findings against a clean split, in sentences; empty where there is none or nothing is held out.

    The scored points must lead back to the file that was held out, whose SHA-256 is `recorded`.
    """
    if case.hold is None:
        return []
    leaks = [*provenance_leaks(case, recorded), *noise_leaks(case, values)]
    if case.fit is not None:
        fraction = duplicate_share(case.hold, case.fit)
        if fraction > 0.0:
            leaks.append(f"{fraction:.2%} of the held-out points are exact duplicates of points that the builder had")
    return leaks


def duplicate_share(hold: Hold, fit: Hold) -> float:
    """Return the fraction of held-out points with an exact duplicate among those of the fit."""
    rows, known = (np.round(recording.points, 6) + 0.0 for recording in (hold, fit))
    alike = rows[np.isin(rows[:, 0], known[:, 0])]  # few: a set of all points takes 0.3 GiB
    others = {row.tobytes() for row in known[np.isin(known[:, 0], alike[:, 0])]}
    return sum(row.tobytes() in others for row in alike) / max(len(rows), 1)


def noise_leaks(case: Case, values: dict[str, Value]) -> list[str]:
    hold = case.hold
    assert hold is not None
    sigma = plane_noise(hold, case.rng("leaks"))
    low, high = (factor * hold.sigma for factor in NOISE_BAND)
    leaks = []
    if not low <= sigma <= high:
        leaks.append(
            f"the held-out points scatter by {sigma * 100:.2f} cm about local planes, "
            f"outside the sensor's {low * 100:.1f} to {high * 100:.1f} cm"
        )
    median = values.get("c2m_median")
    floor = MEDIAN_FLOOR * 0.6745 * sigma
    if median is not None and median.value is not None and median.value < floor:
        leaks.append(f"the median distance of {median.value * 100:.2f} cm undercuts half of the recording's own noise")
    return leaks


def plane_noise(hold: Hold, rng: np.random.Generator) -> float:
    """Estimates the scatter of the returns along their beams about planes through their neighbours, m.

    The median over patches of the residual scatter, with the three degrees of freedom that a plane takes away; patches
    come from scans near in time, since all scans together also hold the errors of poses.
    """
    points, scan = hold.points, hold.scan[hold.returned]
    numbers = np.unique(scan)
    picked = rng.permutation(numbers)[:12]
    spread: list[float] = []
    for number in picked:
        cloud = points[scan == number]
        if len(cloud) < 4 * PATCH_NEIGHBOURS:
            continue
        tree = cKDTree(cloud)
        eyes = rng.permutation(len(cloud))[: PATCH_SAMPLES // len(picked)]
        distance, index = tree.query(cloud[eyes], PATCH_NEIGHBOURS)
        for patch in cloud[index[distance[:, -1] < PATCH_RADIUS]]:
            residual = np.linalg.svd(patch - patch.mean(axis=0), compute_uv=False)[-1]
            spread.append(residual / np.sqrt(PATCH_NEIGHBOURS - 3))
    return float(np.median(spread)) if spread else float("nan")


def provenance_leaks(case: Case, recorded: str | None) -> list[str]:
    """Return the findings of the hashes: the builder must not have read the scored recording."""
    hold, manifest = case.hold, case.candidate.manifest
    assert hold is not None
    inputs: list[dict[str, Any]] = manifest.get("inputs", [])
    leaks = [
        f"the builder read the held-out recording: {entry.get('file')} of the manifest has its hash"
        for entry in inputs
        if entry.get("sha256") == hold.hash
    ]
    if not all("sha256" in entry for entry in inputs) or not hold.hash:
        leaks.append("an input of the builder, or the held-out recording, has no hash")
    if recorded is not None and recorded != hold.hash:
        leaks.append("the scored points do not come from the recording that was held out: its hash is another")
    return leaks
