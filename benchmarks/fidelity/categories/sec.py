"""SEC: size and shape of the cross-sections, every metre, pockets left out."""

from collections.abc import Callable

import numpy as np
import shapely

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.sections import dimensions, sections, variation
from benchmarks.fidelity.registry import metric
from benchmarks.fidelity.value import Value, estimate, number

_STILL = 1e-3  # m; a section that varies by less does not vary


def mean(values: np.ndarray) -> float:
    """Arithmetic mean."""
    return float(np.mean(values))


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def at(percent: float) -> Callable[[np.ndarray], float]:
    """That percentile."""
    return lambda values: float(np.percentile(values, percent))


def _of_size(case: Case, id: str, name: str, statistic: Callable[[np.ndarray], float]) -> Value:
    judged, reference = dimensions(case)[name]
    return estimate(statistic, judged - reference, sections(case).station, case.rng(id))


def _of_area(case: Case, id: str, statistic: Callable[[np.ndarray], float]) -> Value:
    judged, reference = dimensions(case)["area"]
    return estimate(statistic, 100.0 * np.abs(judged / reference - 1.0), sections(case).station, case.rng(id))


def _of_overlap(case: Case, id: str, statistic: Callable[[np.ndarray], float]) -> Value:
    cut = sections(case)
    union = shapely.area(shapely.union(cut.judged_outline, cut.reference_outline))
    return estimate(statistic, shapely.area(cut.common) / union, cut.station, case.rng(id))


def _break(case: Case, id: str, side: int) -> Value:
    """Area of one outline (0 the lining's, 1 the reference's) outside the other, % of the reference's mean."""
    area = dimensions(case)["area"]
    outside = area[side] - shapely.area(sections(case).common)
    return estimate(mean, 100.0 * outside / area[1].mean(), sections(case).station, case.rng(id))


@metric("sec_width_bias", needs="reference")
def sec_width_bias(case: Case) -> Value:
    """Mean error of the width at 1.2 m above the floor, m, absolute."""
    return _of_size(case, "sec_width_bias", "width", lambda e: abs(mean(e)))


@metric("sec_width_rmse", needs="reference")
def sec_width_rmse(case: Case) -> Value:
    """Root mean square of the same error, m."""
    return _of_size(case, "sec_width_rmse", "width", rms)


@metric("sec_height_bias", needs="reference")
def sec_height_bias(case: Case) -> Value:
    """Mean error of the height on the axis, m, absolute."""
    return _of_size(case, "sec_height_bias", "height", lambda e: abs(mean(e)))


@metric("sec_height_rmse", needs="reference")
def sec_height_rmse(case: Case) -> Value:
    """Root mean square of the same error, m."""
    return _of_size(case, "sec_height_rmse", "height", rms)


@metric("sec_area_rel_err_mean", needs="reference")
def sec_area_rel_err_mean(case: Case) -> Value:
    """Mean relative error of the area, %."""
    return _of_area(case, "sec_area_rel_err_mean", mean)


@metric("sec_area_rel_err_p95", needs="reference")
def sec_area_rel_err_p95(case: Case) -> Value:
    """95th percentile of the same, %."""
    return _of_area(case, "sec_area_rel_err_p95", at(95))


@metric("sec_iou_mean", needs="reference")
def sec_iou_mean(case: Case) -> Value:
    """Mean intersection over union of the outlines."""
    return _of_overlap(case, "sec_iou_mean", mean)


@metric("sec_iou_p05", needs="reference")
def sec_iou_p05(case: Case) -> Value:
    """5th percentile of the same."""
    return _of_overlap(case, "sec_iou_p05", at(5))


@metric("sec_overbreak_vol", needs="reference")
def sec_overbreak_vol(case: Case) -> Value:
    """Volume of the lining's air outside the reference's, %."""
    return _break(case, "sec_overbreak_vol", 0)


@metric("sec_underbreak_vol", needs="reference")
def sec_underbreak_vol(case: Case) -> Value:
    """Volume of the reference's air outside the lining's, %."""
    return _break(case, "sec_underbreak_vol", 1)


@metric("sec_radial_rmse", needs="reference")
def sec_radial_rmse(case: Case) -> Value:
    """Root mean square of the radius about the reference axis where the reference is known, m."""
    cut = sections(case)
    error = (cut.judged - cut.reference).ravel()
    return estimate(rms, error, np.repeat(cut.station, len(cut.angle)), case.rng("sec_radial_rmse"))


@metric("sec_variation_corr", needs="reference")
def sec_variation_corr(case: Case) -> Value:
    """Correlation of width and height less their trends; 0 for a lining that does not vary."""
    judged, reference = variation(case)
    if judged.std() < _STILL:
        return number(0.0, judged.size, "the lining's section does not vary")

    def correlation(index: np.ndarray) -> float:
        row = index.astype(int)
        return float(np.corrcoef(judged[row].ravel(), reference[row].ravel())[0, 1])

    index = np.arange(len(judged), dtype=float)
    return estimate(correlation, index, sections(case).station, case.rng("sec_variation_corr"))


@metric("sec_variation_ratio", needs="reference")
def sec_variation_ratio(case: Case) -> Value:
    """Standard deviation of the same in the lining over that in the reference."""
    judged, reference = variation(case)

    def ratio(index: np.ndarray) -> float:
        row = index.astype(int)
        return float(judged[row].std() / max(reference[row].std(), 1e-12))

    index = np.arange(len(judged), dtype=float)
    return estimate(ratio, index, sections(case).station, case.rng("sec_variation_ratio"))
