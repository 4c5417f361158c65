"""CMP, completeness both ways between what held-out beams saw of the candidate and what they measured."""

import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.density import density_aware_chamfer
from benchmarks.fidelity.derive.distances import BOOTSTRAP, to_cloud, to_mesh
from benchmarks.fidelity.derive.extent import bins
from benchmarks.fidelity.derive.observed import phantom
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, number

_FEWEST = 100  # samples in a bin that counts
_FAR = 0.20  # m


def _complete(case: Case, within: float) -> np.ndarray:
    return (to_cloud(case).distance <= within * case.tolerance).astype(float)


def _precision(case: Case, within: float) -> float:
    return float(np.mean(to_mesh(case).distance <= within * case.tolerance))


def _fscore(case: Case, within: float) -> Value:
    precision, recall = _precision(case, within), float(np.mean(_complete(case, within)))
    return number(2.0 * precision * recall / max(precision + recall, 1e-12), len(to_cloud(case).distance))


@metric("comp_10cm", needs="hold")
def comp_10cm(case: Case) -> Value:
    """Share of the observable candidate with a held-out point within 10 cm."""
    return estimate(np.mean, _complete(case, 0.10), to_cloud(case).station, case.rng("comp_10cm"), BOOTSTRAP)


@metric("comp_20cm", needs="hold")
def comp_20cm(case: Case) -> Value:
    """The same within 20 cm."""
    return estimate(np.mean, _complete(case, 0.20), to_cloud(case).station, case.rng("comp_20cm"), BOOTSTRAP)


@metric("fscore_5cm", needs="hold")
def fscore_5cm(case: Case) -> Value:
    """Harmonic mean of precision and completeness at 5 cm."""
    return _fscore(case, 0.05)


@metric("fscore_10cm", needs="hold")
def fscore_10cm(case: Case) -> Value:
    """The same at 10 cm."""
    return _fscore(case, 0.10)


@metric("fscore_20cm", needs="hold")
def fscore_20cm(case: Case) -> Value:
    """The same at 20 cm."""
    return _fscore(case, 0.20)


@metric("chamfer_l1", needs="hold")
def chamfer_l1(case: Case) -> Value:
    """Mean of the two directed mean distances, m."""
    return number(float(np.mean(to_mesh(case).distance) + np.mean(to_cloud(case).distance)) / 2.0)


@metric("dcd", needs="hold")
def dcd(case: Case) -> Value:
    """Density-aware Chamfer distance between held-out and synthetic cloud."""
    return number(density_aware_chamfer(case))


@metric("hausdorff_p99", needs="hold")
def hausdorff_p99(case: Case) -> Value:
    """Larger of the two directed 99th percentiles, m."""
    return number(max(float(np.percentile(d, 99)) for d in (to_mesh(case).distance, to_cloud(case).distance)))


@metric("comp_chainage_min", needs="hold")
def comp_chainage_min(case: Case) -> Value:
    """Smallest `comp_10cm` of a bin of about 10 m; 0 where there are held-out returns but no candidate."""
    group = bins(case, to_cloud(case).station)
    total = bins(case, returns(case).local[:, 0])
    bin_count = int(total.max()) + 1
    count = np.bincount(group, minlength=bin_count)
    share = np.bincount(group, _complete(case, 0.10), minlength=bin_count) / np.maximum(count, 1)
    judged = np.bincount(total, minlength=bin_count) >= _FEWEST
    return number(float(share[judged].min()), len(group))


@metric("extra_surface_frac", needs="hold")
def extra_surface_frac(case: Case) -> Value:
    """Share of the observable candidate through which held-out beams passed."""
    return number(float(np.mean(phantom(case))), len(phantom(case)))


@metric("missing_surface_frac", needs="hold")
def missing_surface_frac(case: Case) -> Value:
    """Share of held-out points with no candidate within 20 cm."""
    found = to_mesh(case)
    far = (found.distance > _FAR * case.tolerance).astype(float)
    return estimate(np.mean, far, found.station, case.rng("missing_surface_frac"), BOOTSTRAP)
