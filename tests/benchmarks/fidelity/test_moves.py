"""Nothing in the score is true by construction: for each scored metric a fault moves its value and its score.

Faults that no control does are registered here, as a user's own file would. The slow test puts all of them into a
survey made anew.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity import scoring, table
from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults import Fault, Site, fault_kind, put_in
from benchmarks.fidelity.faults.kinds import load_controls, local_site
from benchmarks.fidelity.faults.mesh import change_both, copy_scene
from benchmarks.fidelity.inputs import Inputs, complete_inputs, make, read_case
from benchmarks.fidelity.meshes import keep_bodies, without_faces
from tests.benchmarks.fidelity.judged import measure

LEAST = 5.0  # points that the fault must cost the metric
SEED = 411


@fault_kind("unfinite", "a vertex that is no number")
def lose_a_vertex(site: Site, fault: Fault) -> Candidate:
    vertices = site.candidate.lining.vertices.copy()
    vertices[5, 1] = np.nan
    return replace(site.candidate, lining=trimesh.Trimesh(vertices, site.candidate.lining.faces, process=False))


@fault_kind("swollen", "solid 2 % larger than the sections")
def swell_the_solid(site: Site, fault: Fault) -> Candidate:
    solid = site.candidate.solid.copy()
    solid.apply_scale(1.02)
    return replace(site.candidate, solid=solid)


@fault_kind("flattened", "faces without area")
def flatten_a_face(site: Site, fault: Fault) -> Candidate:
    def flat(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        corner = mesh.faces[::500, :2]
        return trimesh.Trimesh(mesh.vertices, np.vstack([mesh.faces, corner[:, [0, 0, 1]]]), process=False)

    return change_both(site.candidate, flat)


@fault_kind("spanned", "a face from one mouth to the other")
def span_the_bend(site: Site, fault: Fault) -> Candidate:
    lining = site.candidate.lining
    station = site.line.local(np.asarray(lining.vertices))[:, 0]
    first, last = int(np.argmin(station)), int(np.argmax(station))
    faces = np.vstack([lining.faces, [first, first + 1, last]])
    return replace(site.candidate, lining=trimesh.Trimesh(lining.vertices, faces, process=False))


@fault_kind("cut rails", "rails missing from station 10 to 11 m")
def cut_the_rails(site: Site, fault: Fault) -> Candidate:
    cut = local_site(site.case).candidate
    mesh = cut.track.rail_mesh
    station = site.line.local(np.asarray(mesh.triangles_center))[:, 0]
    return replace(cut, track=replace(cut.track, rail_mesh=without_faces(mesh, (station > 10.0) & (station < 11.0))))


@fault_kind("lost fastenings", "fastenings of 6 m missing")
def lose_fastenings(site: Site, fault: Fault) -> Candidate:
    track = site.candidate.track
    left = keep_bodies(track.fastening_mesh, lambda middle: site.line.local(middle)[:, 0] > 6.0)
    return replace(site.candidate, track=replace(track, fastening_mesh=left))


@fault_kind("uneven sleepers", "every second sleeper 5 cm along")
def space_unevenly(site: Site, fault: Fault) -> Candidate:
    track = site.candidate.track
    local = site.line.local(track.sleeper)
    local[np.argsort(local[:, 0])[::2], 0] += 0.05
    return replace(site.candidate, track=replace(track, sleeper=site.line.point(local)))


def edit(name: str, path: str, change: Callable[[ElementTree.Element], None]) -> None:
    """Registers a fault that changes every element of the scene's file that a path finds, in a copy of its folder."""

    @fault_kind(name, name)
    def edited(site: Site, fault: Fault) -> Candidate:
        copy = copy_scene(site.candidate, site.scratch)
        root = ElementTree.fromstring(copy.scene.read_text())
        assert root.findall(path), path
        for element in root.findall(path):
            change(element)
        copy.scene.write_text(ElementTree.tostring(root, encoding="unicode"))
        return copy


def put(**attributes: str) -> Callable[[ElementTree.Element], None]:
    return lambda element: element.attrib.update(attributes)


def move(*by: float) -> Callable[[ElementTree.Element], None]:
    def moved(element: ElementTree.Element) -> None:
        place = np.fromstring(element.get("pos", "0 0 0"), sep=" ") + by
        element.set("pos", " ".join(f"{value:.9g}" for value in place))

    return moved


def stiffen(root: ElementTree.Element) -> None:
    for geom in root.findall("./worldbody/body/geom"):
        geom.attrib |= {"solref": "-1000000000 0", "solimp": "0.99 0.999 0.001"}
    for option in root.findall("./option"):
        option.attrib |= {"integrator": "Euler", "timestep": "0.1"}


edit("same names", ".//geom[@name='sleeper_0003']", put(name="sleeper_0004"))
edit("moved lining", ".//geom[@name='lining_000']", move(0.0, 0.05, 0.0))
edit("lost sleeper", ".//geom[@name='sleeper_0003']", put(name="plank"))
edit("far scene", "./worldbody/*", move(1e6, 0.0, 0.0))
edit("stiff contacts", ".", stiffen)
edit("ellipsoid", "./worldbody/body/geom", put(type="ellipsoid", size="0.3 0.2 0.3"))


def control(id: str, dose: float) -> Fault:
    return load_controls()[id].faults[dose]


MOVES: dict[Fault, str] = {
    control("N11", 0.5): (
        "cl_lateral_rmse cl_lateral_p95 cl_heading_rmse cl_icp_rotation nav_path_len_ratio nav_path_dev_p95 "
    ),
    Fault("lift", 0.15, 12.0, 10.0): "cl_vertical_rmse cl_grade_rmse",
    control("N04", 5.0): "cl_length_rel_err cl_end_station_err cl_axial_drift_slope trk_sleeper_spacing_err",
    control("N10", 100.0): "cl_curvature_rmse",
    control("N02", 5.0): (
        "sec_width_bias sec_width_rmse sec_height_bias sec_height_rmse sec_area_rel_err_mean "
        "sec_area_rel_err_p95 sec_iou_mean sec_iou_p05 sec_overbreak_vol sec_radial_rmse c2m_mean c2m_median "
        "c2m_rmse c2m_p95 c2m_within_5cm c2m_within_10cm c2m_signed_bias c2m_chainage_worst c2m_sector_worst "
        "c2m_noise_ratio m3c2_signif_frac comp_10cm fscore_10cm chamfer_l1 comp_chainage_min beam_range_mae "
        "beam_range_medae beam_range_bias beam_range_p95 beam_within_10cm beam_rel_medae beam_late_frac "
        "range_ks range_w1 elevation_w1 azimuth_profile_rmse awd c2st_auc occ2d_free_iou occ2d_free_precision "
        "occ2d_boundary_f1 free2d_area_rel_err free2d_width_mae free2d_width_min_err free2d_edt_rmse "
        "free3d_iou free3d_volume_rel_err free3d_esdf_rmse free3d_inscribed_err free3d_headroom_rmse "
        "free3d_envelope_agree vox_iou_norm vox_precision vox_recall vox_kappa vox_proj_iou_xy "
        "vox_proj_iou_xz vox_proj_iou_yz nav_traversable_iou "
    ),
    Fault("tube", 2): (
        "sec_underbreak_vol sec_variation_corr sec_variation_ratio beam_early_frac tri_edge_p95 "
        "nav_clearance_min_err nav_clearance_mean_err nav_step_p95_err lin_depth_map_ncc lin_pocket_f1 "
        "lin_pocket_count_rel_err lin_axial_pitch_err lin_circ_pitch_err lin_ring_phase_err trk_sleeper_f1 "
        "trk_sleeper_count_rel_err "
    ),
    control("N32", 2.0): (
        "c2m_fit_hold_gap beam_return_bacc incidence_w1 noise_sigma_diff mme_diff vox_f1_tol1 "
        "vox_interior_mismatch vox_chainage_min_f1 deg_rot_info_logratio deg_profile_corr deg_alias_diff "
    ),
    control("N20", 2.0): (
        "fscore_20cm hausdorff_p99 extra_surface_frac topo_body_count_err topo_chi_err topo_genus "
        "topo_free_b0 topo_bottleneck_h0 topo_floater_area free2d_skeleton_p95 free3d_false_occupied "
        "free3d_hold_poses_free nav_path_exists nav_feasible_agree nav_blocked_diff deg_axial_info_logratio "
        "deg_cond_logratio deg_eig_w1 deg_landmark_diff "
    ),
    control("N09", 10.0): "missing_surface_frac",
    control("N28", 1.0): "dropout_diff",
    Fault("unfinite"): "mesh_finite",
    control("N16", 2.0): (
        "mesh_watertight mesh_winding_consistent mesh_is_volume mesh_manifold_status mesh_boundary_unexpected "
        "mesh_nonmanifold_edges mesh_duplicate_faces mesh_self_intersections tri_sliver_frac topo_mouth_err "
    ),
    control("N14", 1.0): "mesh_orientation_frac",
    Fault("flattened"): "mesh_degenerate_faces",
    Fault("swollen"): "mesh_volume_vs_sections",
    Fault("doubled", 0.2): "tri_aspect_p95 tri_min_angle_p05",
    Fault("spanned"): "tri_chord_error_max",
    control("N18", 0.05): "tri_normal_noise tri_roughness_ratio nav_drivable_width_mae lin_pocket_area_rel_err",
    control("N12", 5.0): "topo_leak_frac",
    control("N21", 30.0): "topo_free_b1_err topo_free_b2_err",
    control("N07", 0.1): "occ2d_free_recall",
    Fault("section", 0.1): "free3d_false_free",
    control("N26", 2.0): "lin_pocket_depth_bias lin_pocket_depth_mae",
    Fault("uneven sleepers"): "trk_sleeper_spacing_std_err",
    Fault("track", 2.0, 12.0, 10.0): "trk_sleeper_in_bore trk_rail_lateral_rmse",
    control("N24", 1.445): "trk_gauge_mean_err trk_gauge_p95_dev",
    control("N08", 0.15): "trk_rail_height_rmse",
    Fault("cut rails"): "trk_rail_gap_max",
    Fault("lost fastenings"): "trk_fastener_ratio",
    Fault("rails", 0.03, 12.0, 10.0): "trk_asset_penetration_max",
    Fault("same names"): "mj_compiles",
    Fault("stiff contacts"): "mj_step_finite",
    control("N29", 1.0): "mj_probe_free_frac mj_wall_contact_err mjx_contact_parity mjx_traj_divergence",
    Fault("moved lining"): "mj_ray_vs_mesh_mae mj_ray_leak_rate mj_frame_err",
    Fault("lost sleeper"): "mj_manifest_match",
    Fault("far scene"): "mj_xml_roundtrip",
    Fault("ellipsoid"): "mjx_put_model",
    control("N31", 0.3): "mjx_ray_parity env_lidar_vs_mesh",
    control("N05", 2.0): "deg_weak_angle_diff",
}  # fmt: skip


def test_every_scored_metric_has_a_fault_that_moves_it() -> None:
    counted = Counter(id for ids in MOVES.values() for id in ids.split())
    assert counted == Counter(id for id, row in table.load().items() if row.scored)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_on_a_survey_made_anew_every_fault_moves_its_metrics(tmp_path: Path) -> None:
    case = make_case(tmp_path)
    before = {id: measure(id, case) for ids in MOVES.values() for id in ids.split()}
    case.cache.clear()
    rows = table.load()
    full = [scoring.score_one(rows[id], value).score == 100.0 for id, value in before.items()]
    assert sum(full) < 0.7 * len(full)  # the scale is not used up by a good reconstruction
    still = []
    for number, (fault, ids) in enumerate(MOVES.items()):
        corrupted = put_in(Site(case, scratch=tmp_path / str(number)), fault)
        for id in ids.split():
            after = measure(id, corrupted)
            cost = scoring.score_one(rows[id], before[id]).score - scoring.score_one(rows[id], after).score
            if before[id].value == after.value or cost < LEAST:
                still.append((id, fault, before[id].value, after.value, cost))
        corrupted.cache.clear()
    assert still == []


def make_case(folder: Path) -> Case:
    """Simulates a 36 m survey, builds its scene from the Avia, and judges it by the OS1."""
    survey, scene = folder / "survey", folder / "scene"
    make("scene.survey", "--truth", "metro", "--length", 36, "--seed", SEED, "--tolerances",
               "--sensors", "avia", "os1", "--scan-every", 6, "--out", survey)  # fmt: skip
    make("scene.build", survey / "survey.bag", "--trajectory", survey / "groundtruth.tum",
               "--provenance", "simulated", "--out", scene)  # fmt: skip
    return read_case(complete_inputs(Inputs(
        scene=scene, recording=survey / "survey_os1.bag", trajectory=survey / "groundtruth_os1.tum", truth=survey,
        fit_recording=survey / "survey.bag", fit_trajectory=survey / "groundtruth.tum",
    )))  # fmt: skip
