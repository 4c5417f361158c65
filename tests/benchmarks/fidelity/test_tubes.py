"""Tubes with one dimension wrong: what each metric says of it, by dimension; a copy is right within noise."""

from math import inf, pi

import numpy as np
import pytest

from tests.benchmarks.fidelity.judged import BARE, DEFAULT, PLAIN, SHORT, against, category, judged, raw

SIGMA = 0.02  # m, of the recording's ranges
Bounds = tuple[float, float]


def about(value: float, by: float = 1e-9) -> Bounds:
    return value - by, value + by


def below(value: float) -> Bounds:
    return -inf, np.nextafter(value, -inf)


def above(value: float) -> Bounds:
    return np.nextafter(value, inf), inf


HEARD = {"heard": True}  # by the recording alone
KNOWN = (
    (BARE, {}, {
        "cl_lateral_rmse": below(1e-3), "cl_vertical_rmse": below(5e-3), "cl_heading_rmse": below(0.01),
        "cl_length_rel_err": below(0.01), "cl_end_station_err": below(0.01), "cl_axial_drift_slope": below(1e-6),
        "cl_icp_rotation": below(0.1)}),
    (BARE, {"shift": (0.1, 0.0)}, {
        "cl_lateral_rmse": about(0.1, 1e-3), "cl_lateral_p95": about(0.1, 1e-3), "cl_heading_rmse": below(0.01)}),
    (BARE, {"shift": (0.0, 0.07)}, {"cl_vertical_rmse": about(0.07, 5e-3), "cl_lateral_rmse": below(1e-3)}),
    (BARE, {"bend": 1e6}, {"cl_curvature_rmse": about(1 / 300, 0.02 / 300), "cl_lateral_rmse": above(0.1)}),
    (BARE, {"grade": 0.03}, {"cl_grade_rmse": about(2.0, 0.1)}),
    (BARE, {"length": 16.0}, {
        "cl_length_rel_err": about(100 * 2 / 18, 0.11), "cl_end_station_err": about(2.0, 0.02)}),
    (BARE, {"heading": 0.3 + np.deg2rad(1.0)}, {"cl_icp_rotation": about(1.0, 0.15)}),
    (BARE, HEARD, {"cl_lateral_rmse": below(0.02), "cl_vertical_rmse": below(0.03)}),
    (PLAIN, {}, {
        "sec_width_rmse": below(1e-6), "sec_iou_p05": above(0.999999), "sec_variation_corr": about(1.0, 1e-6),
        "sec_variation_ratio": about(1.0, 1e-6), "lin_pocket_f1": about(1.0), "lin_pocket_count_rel_err": about(0.0),
        "lin_pocket_depth_bias": below(5e-3), "lin_pocket_area_rel_err": below(25.0),
        "lin_ring_phase_err": below(1e-3), "lin_depth_map_ncc": above(0.7)}),
    (PLAIN, {"width": 5.7}, {
        "sec_width_bias": about(0.1, 2e-3), "sec_height_bias": below(1e-3), "sec_overbreak_vol": about(1.6, 0.1),
        "sec_underbreak_vol": below(0.01)}),
    (PLAIN, {"variation": 0.0}, {"sec_variation_corr": about(0.0), "sec_variation_ratio": below(0.01)}),
    (PLAIN, {"length": 16.0}, {"sec_underbreak_vol": about(100 / 17, 5 / 17), "sec_iou_p05": below(0.85)}),
    (PLAIN, {"shift": (0.1, 0.0)}, {
        "sec_width_rmse": below(1e-3), "sec_iou_mean": below(0.97), "sec_radial_rmse": above(0.05)}),
    (PLAIN, {"depth": 0.0}, {  # pockets are no part of the section
        "sec_width_rmse": below(1e-3), "lin_pocket_f1": about(0.0), "lin_pocket_count_rel_err": about(100.0),
        "lin_axial_pitch_err": about(100.0), "lin_depth_map_ncc": below(0.2)}),
    (PLAIN, {"depth": 0.20}, {"lin_pocket_depth_mae": about(0.07, 5e-3), "lin_pocket_f1": about(1.0)}),
    (PLAIN, {"rings": 1.2}, {
        "lin_ring_phase_err": about(1 / 3, 0.02), "lin_axial_pitch_err": below(0.5), "lin_pocket_f1": below(0.6)}),
    (PLAIN, {"rings": 0.92}, {"lin_pocket_f1": below(0.2)}),  # 22 cm from a pocket on either side
    (PLAIN, {"pitch": 1.6}, {"lin_axial_pitch_err": about(100 * 0.1 / 1.5, 1.0)}),
    (PLAIN, HEARD, {
        "sec_width_bias": below(0.03), "sec_height_bias": below(0.03), "lin_pocket_f1": above(0.6),
        "lin_ring_phase_err": below(0.05)}),
    (PLAIN, HEARD | {"width": 5.8}, {"sec_width_bias": about(0.2, 0.03)}),
    (PLAIN, HEARD | {"depth": 0.0}, {"lin_pocket_f1": about(0.0)}),
    (SHORT, {}, {
        "occ2d_free_iou": about(1.0), "occ2d_boundary_f1": about(1.0), "free2d_width_mae": below(1e-6),
        "free2d_edt_rmse": about(0.0), "free3d_iou": above(0.997), "free3d_esdf_rmse": below(1e-6),
        "free3d_headroom_rmse": below(1e-3), "free3d_envelope_agree": about(1.0), "free3d_false_free": about(0.0),
        "free3d_false_occupied": below(1e-3), "free3d_hold_poses_free": about(1.0),
        "free3d_voxel_vs_mesh_vol": below(2.0), "nav_path_exists": about(1.0), "nav_path_len_ratio": about(1.0),
        "nav_path_dev_p95": about(0.0), "nav_feasible_agree": about(1.0), "nav_traversable_iou": about(1.0),
        "nav_blocked_diff": about(0.0), "nav_clearance_min_err": about(0.0), "nav_clearance_mean_err": about(0.0),
        "mesh_finite": about(1.0), "mesh_watertight": about(1.0), "mesh_winding_consistent": about(1.0),
        "mesh_is_volume": about(1.0), "mesh_manifold_status": about(1.0), "mesh_orientation_frac": about(1.0),
        "mesh_boundary_unexpected": about(0.0), "mesh_nonmanifold_edges": about(0.0),
        "mesh_duplicate_faces": about(0.0), "mesh_degenerate_faces": about(0.0), "mesh_self_intersections": about(0.0),
        "topo_body_count_err": about(0.0), "topo_chi_err": about(0.0), "topo_genus": about(0.0),
        "topo_mouth_err": about(0.0), "topo_leak_frac": about(0.0), "topo_free_b0": about(1.0),
        "topo_free_b1_err": about(0.0), "topo_free_b2_err": about(0.0), "topo_bottleneck_h0": about(0.0),
        "topo_bottleneck_h1": about(0.0), "topo_floater_area": about(0.0), "tri_chord_error_max": below(1e-3)}),
    (SHORT, {"width": 5.8}, {
        "free2d_width_mae": about(0.2, 5e-3), "free2d_width_min_err": about(0.2, 5e-3),
        "free2d_area_rel_err": about(100 * 0.2 / 5.6, 1.0), "occ2d_free_precision": below(0.98),
        "occ2d_free_recall": about(1.0), "free3d_inscribed_err": about(0.1, 0.01)}),
    (SHORT, {"width": 6.4}, {"free3d_false_free": above(0.2), "free3d_volume_rel_err": above(5.0)}),
    (SHORT, {"width": 4.8}, {"free3d_false_occupied": above(0.02)}),
    (SHORT, {"height": 6.4}, {"free3d_headroom_rmse": about(0.2, 0.02)}),
    (SHORT, {"height": 6.0}, {"free3d_envelope_agree": below(0.9)}),
    (SHORT, {"bend": 40.0}, {"free2d_skeleton_p95": above(0.3)}),
    (SHORT, {"track": False}, {"nav_drivable_width_mae": above(0.5), "nav_traversable_iou": below(0.9)}),
    (SHORT, {"spacing": 0.66}, {
        "trk_sleeper_spacing_err": about(0.06, 1e-3), "trk_sleeper_f1": below(0.7),
        "trk_sleeper_count_rel_err": about(100 * 2 / 20, 0.1)}),
    (SHORT, {"gauge": 1.445}, {"trk_gauge_mean_err": about(10.0, 0.2), "trk_gauge_p95_dev": about(10.0, 0.5)}),
    (SHORT, {"gauge": SHORT.gauge + 0.2}, {  # rails 10 cm farther out give the way 10 cm more room
        "nav_clearance_min_err": about(0.1, 0.02), "nav_clearance_mean_err": about(0.1, 0.02)}),
    (SHORT, {"gauge": 1.425}, {"trk_gauge_mean_err": about(10.0, 0.2), "trk_gauge_p95_dev": about(10.0, 0.5)}),
    (SHORT, {"shift": (0.05, 0.03)}, {
        "trk_rail_lateral_rmse": about(0.05, 2e-3), "trk_rail_height_rmse": about(0.03, 4e-3)}),
    (SHORT, HEARD, {
        "occ2d_free_iou": above(0.97), "free2d_area_rel_err": below(2.0), "occ2d_unknown_frac": (1e-6, 0.8),
        "free3d_iou": above(0.93), "free3d_esdf_rmse": below(0.1), "free3d_headroom_rmse": below(0.06),
        "nav_path_len_ratio": about(1.0, 0.05), "nav_traversable_iou": above(0.6)}),
    (SHORT, HEARD | {"width": 6.2}, {"free2d_area_rel_err": above(8.0)}),
    (DEFAULT, {}, {
        "c2m_median": below(0.6745 * SIGMA), "c2m_signed_bias": below(0.001), "c2m_within_10cm": above(0.999),
        "m3c2_signif_frac": below(0.01), "comp_10cm": above(0.99), "comp_20cm": above(0.99), "fscore_10cm": above(0.99),
        "scs_diff": (0.0, inf),
        "extra_surface_frac": below(0.001), "missing_surface_frac": about(0.0), "range_ks": below(0.005),
        "range_w1": below(0.01), "incidence_w1": below(0.5), "c2st_auc": below(0.65),
        "vox_iou_norm": about(1.0, 0.02), "vox_iou_20cm": below(1.0), "vox_f1_tol1": above(0.999),
        "vox_interior_mismatch": below(0.01), "deg_axial_info_logratio": below(0.06),
        "deg_cond_logratio": below(0.06), "deg_weak_angle_diff": below(2.0), "deg_rot_info_logratio": below(0.06),
        "deg_landmark_diff": below(1.0), "deg_icp_axial_logratio": (0.0, inf), "deg_alias_diff": below(0.2)}),
    (DEFAULT, {"length": 14.0}, {
        "c2m_chainage_worst": above(0.5), "beam_within_10cm": below(0.9), "vox_chainage_min_f1": below(0.9)}),
    (DEFAULT, {"height": 6.6}, {"comp_chainage_min": below(0.9)}),
    (DEFAULT, {}, {
        "cl_icp_translation": below(0.03), "sec_height_rmse": below(1e-6), "sec_area_rel_err_mean": below(1e-6),
        "sec_area_rel_err_p95": below(1e-6), "c2m_p99": below(2.6 * SIGMA), "c2m_within_5cm": above(0.98),
        "beam_range_p95": about(1.96 * SIGMA, 0.1 * SIGMA), "lin_circ_pitch_err": below(1.0)}),
    (DEFAULT, {"shift": (0.1, 0.0)}, {"cl_icp_translation": about(0.1, 0.03)}),
    (DEFAULT, {"height": 6.3}, {"sec_height_rmse": about(0.1, 2e-3)}),
    (DEFAULT, {"variation": 0.0}, {  # the area is off by twice the variation
        "sec_area_rel_err_mean": about(100 * 2 * 0.006 * 2 / pi, 0.1), "sec_area_rel_err_p95": about(1.2, 0.1)}),
    (DEFAULT, {"width": 5.8}, {
        "c2m_p99": above(0.1), "c2m_within_5cm": below(0.75), "beam_range_p95": above(0.1),
        "beam_rel_medae": above(0.2)}),
    (DEFAULT, {"depth": 0.0}, {"lin_circ_pitch_err": about(100.0)}),
    (DEFAULT, {"track": False}, {"deg_alias_diff": above(0.0)}),
)  # fmt: skip


@pytest.mark.parametrize(
    ("right", "changes", "known"), KNOWN, ids=[f"{next(iter(ids))[:3]}-{changes}" for _, changes, ids in KNOWN]
)
def test_a_tube_of_other_dimensions_has_the_values_that_follow(right, changes, known) -> None:
    case = judged(**changes) if right == DEFAULT else against(right, **changes)
    values = {id: raw(id, case) for id in known}
    assert {id: values[id] for id, (low, high) in known.items() if not low <= values[id] <= high} == {}


@pytest.mark.parametrize(("name", "least"), [("C2M", 98.0), ("CMP", 99.0), ("DIS", 98.0), ("OCC", 95.0)])
def test_the_right_tube_is_good_in_a_category(name, least) -> None:
    assert category(name, judged()) > least
