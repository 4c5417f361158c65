"""BEA: recorded held-out beams, cast one by one in the candidate."""

import numpy as np

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import paired, returns
from benchmarks.fidelity.derive.distances import BOOTSTRAP
from benchmarks.fidelity.derive.selfcast import selfcast
from benchmarks.fidelity.derive.silence import silence
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, missing, number

_FAR = 0.20  # m
_NO_SILENCE = "the recording does not hold the beams that came back with nothing"
_CIRCULAR = "by construction: noise about the same mesh, whatever the mesh"


def _error(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Range differences of beams that meet the candidate, and their stations; the others count in `beam_late_frac`."""
    hit = paired(case).hit
    return paired(case).difference[hit], returns(case).local[hit, 0]


@metric("beam_range_mae", needs="hold")
def beam_range_mae(case: Case) -> Value:
    """Mean absolute range difference, m."""
    error, station = _error(case)
    return estimate(np.mean, np.abs(error), station, case.rng("beam_range_mae"), BOOTSTRAP)


@metric("beam_range_medae", needs="hold")
def beam_range_medae(case: Case) -> Value:
    """Median absolute range difference, m."""
    error, station = _error(case)
    return estimate(np.median, np.abs(error), station, case.rng("beam_range_medae"), BOOTSTRAP)


@metric("beam_range_bias", needs="hold")
def beam_range_bias(case: Case) -> Value:
    """Mean range difference without its sign, m."""
    error, station = _error(case)
    return estimate(lambda e: float(abs(np.mean(e))), error, station, case.rng("beam_range_bias"), BOOTSTRAP)


@metric("beam_range_p95", needs="hold")
def beam_range_p95(case: Case) -> Value:
    """95th percentile of the absolute range difference, m."""
    error, station = _error(case)
    return estimate(
        lambda e: float(np.percentile(e, 95)), np.abs(error), station, case.rng("beam_range_p95"), BOOTSTRAP
    )


@metric("beam_within_10cm", needs="hold")
def beam_within_10cm(case: Case) -> Value:
    """Share of the returns that the candidate gives within 10 cm; a beam that leaves it is not within."""
    near = (np.abs(paired(case).difference) <= 0.10 * case.tolerance).astype(float)
    return estimate(np.mean, near, returns(case).local[:, 0], case.rng("beam_within_10cm"), BOOTSTRAP)


@metric("beam_rel_medae", needs="hold")
def beam_rel_medae(case: Case) -> Value:
    """Median absolute range difference as a share of the range, %."""
    hit, (error, station) = paired(case).hit, _error(case)
    relative = 100.0 * np.abs(error) / returns(case).range[hit]
    return estimate(np.median, relative, station, case.rng("beam_rel_medae"), BOOTSTRAP)


@metric("beam_return_bacc", needs="hold")
def beam_return_bacc(case: Case) -> Value:
    """Mean of the shares of beams rightly foreseen to come back and rightly foreseen not to."""
    assert case.hold is not None
    if not case.hold.knows_missing:
        return missing(_NO_SILENCE)
    found = silence(case)
    if not found.silent.any() or found.silent.all():
        return missing("all beams of the recording came back, or none")
    right = [np.mean(found.expected_silent[found.silent]), np.mean(~found.expected_silent[~found.silent])]
    return number(float(np.mean(right)), len(found.silent))


@metric("beam_early_frac", needs="hold")
def beam_early_frac(case: Case) -> Value:
    """Share of the returns in front of which, by more than 20 cm, the candidate stands."""
    early = (paired(case).difference < -_FAR * case.tolerance).astype(float)
    return estimate(np.mean, early, returns(case).local[:, 0], case.rng("beam_early_frac"), BOOTSTRAP)


@metric("beam_late_frac", needs="hold")
def beam_late_frac(case: Case) -> Value:
    """Share of the returns that the candidate gives more than 20 cm later, or not at all."""
    late = (paired(case).difference > _FAR * case.tolerance).astype(float)
    return estimate(np.mean, late, returns(case).local[:, 0], case.rng("beam_late_frac"), BOOTSTRAP)


@metric("selfcast_p2s_mean", needs="hold")
def selfcast_p2s_mean(case: Case) -> Value:
    """The paper's headline: mean distance of a cloud cast in the mesh to that mesh, m."""
    return number(float(np.mean(selfcast(case).distance)), len(selfcast(case).distance), _CIRCULAR)


@metric("selfcast_within_10cm", needs="hold")
def selfcast_within_10cm(case: Case) -> Value:
    """The paper's headline: share of that cloud within 10 cm."""
    near = selfcast(case).distance <= 0.10 * case.tolerance
    return number(float(np.mean(near)), len(near), _CIRCULAR)


@metric("selfcast_noise_ratio", needs="hold")
def selfcast_noise_ratio(case: Case) -> Value:
    """That mean over what noise alone gives on a plane; 1 says that nothing but noise was measured."""
    found = selfcast(case)
    return number(float(np.mean(found.distance) / found.noise_alone), len(found.distance), _CIRCULAR)
