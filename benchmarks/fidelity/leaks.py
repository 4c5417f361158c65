"""The leak detector: whether a builder could know what it is judged by, or that was made from its mesh."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.references import Hold
from benchmarks.fidelity.value import Value

NOISE_BAND = (0.5, 3.0)  # times the sensor's stated sigma
MEDIAN_FLOOR = 0.5  # of the recording's own noise that the median distance to the mesh must not undercut
NEIGHBOURS = 12
PATCH = 0.25  # m within which neighbours must lie to make a plane
SAMPLES = 8_000


def find(case: Case, values: dict[str, Value], recorded: str | None = None) -> list[str]:
    """What speaks against a clean split, in sentences; empty where nothing does or nothing is held out.

    Args:
        case: With the held-out recording.
        values: Of the case; `c2m_median` is read.
        recorded: SHA-256 of the file that was held out, to which the scored points must lead back.
    """
    if case.hold is None:
        return []
    found = [*provenance(case, recorded), *noise(case, values)]
    if case.fit is not None:
        share = duplicates(case.hold, case.fit)
        if share > 0.0:
            found.append(f"{share:.2%} of the held-out points are exact duplicates of points that the builder had")
    return found


def duplicates(hold: Hold, fit: Hold) -> float:
    """Share of held-out points with an exact duplicate among those of the fit."""
    known = {row.tobytes() for row in np.round(fit.points, 6) + 0.0}
    rows = np.round(hold.points, 6) + 0.0
    return float(np.mean([row.tobytes() in known for row in rows])) if len(rows) else 0.0


def noise(case: Case, values: dict[str, Value]) -> list[str]:
    """A recording without noise of its own is no recording."""
    hold = case.hold
    assert hold is not None
    sigma = plane_noise(hold, case.rng("leaks"))
    low, high = (factor * hold.sigma for factor in NOISE_BAND)
    found = []
    if not low <= sigma <= high:
        found.append(
            f"the held-out points scatter by {sigma * 100:.2f} cm about local planes, "
            f"outside the sensor's {low * 100:.1f} to {high * 100:.1f} cm"
        )
    median = values.get("c2m_median")
    floor = MEDIAN_FLOOR * 0.6745 * sigma
    if median is not None and median.value is not None and median.value < floor:
        found.append(f"the median distance of {median.value * 100:.2f} cm undercuts half of the recording's own noise")
    return found


def plane_noise(hold: Hold, rng: np.random.Generator) -> float:
    """Robust scatter of the returns along their beams about planes through their neighbours, m.

    The median over patches of the residual scatter, with the three degrees of freedom that a plane takes away; patches
    come from scans near in time, since all scans together also hold the errors of poses.
    """
    points, scan = hold.points, hold.scan[hold.returned]
    numbers = np.unique(scan)
    picked = rng.permutation(numbers)[:12]
    spread: list[float] = []
    for number in picked:
        cloud = points[scan == number]
        if len(cloud) < 4 * NEIGHBOURS:
            continue
        tree = cKDTree(cloud)
        eyes = rng.permutation(len(cloud))[: SAMPLES // len(picked)]
        distance, index = tree.query(cloud[eyes], NEIGHBOURS)
        for patch in cloud[index[distance[:, -1] < PATCH]]:
            residual = np.linalg.svd(patch - patch.mean(axis=0), compute_uv=False)[-1]
            spread.append(residual / np.sqrt(NEIGHBOURS - 3))
    return float(np.median(spread)) if spread else float("nan")


def provenance(case: Case, recorded: str | None) -> list[str]:
    """Hashes: the builder's inputs must not hold the scored recording, which must be what was held out."""
    hold, manifest = case.hold, case.candidate.manifest
    assert hold is not None
    inputs: list[dict[str, Any]] = manifest.get("inputs", [])
    found = [
        f"the builder read the held-out recording: {entry.get('file')} of the manifest has its hash"
        for entry in inputs
        if entry.get("sha256") == hold.hash
    ]
    if not all("sha256" in entry for entry in inputs) or not hold.hash:
        found.append("an input of the builder, or the held-out recording, has no hash")
    if recorded is not None and recorded != hold.hash:
        found.append("the scored points do not come from the recording that was held out: its hash is another")
    return found


@contextmanager
def opened_files() -> Iterator[set[Path]]:
    """Collects every file that this process opens while the block runs, seen by the interpreter's audit events."""
    seen: set[Path] = set()
    active = [True]

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if active[0] and event == "open" and isinstance(arguments[0], str | bytes):
            name = arguments[0] if isinstance(arguments[0], str) else arguments[0].decode(errors="replace")
            seen.add(Path(name).absolute())

    sys.addaudithook(hook)  # cannot be taken away again, hence the switch
    try:
        yield seen
    finally:
        active[0] = False
