"""Files of a survey, each written under a temporary name and renamed, and its truth for the measuring of builders."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from scene.survey import furniture as fur
from scene.survey.bore import Bore
from scene.survey.config import SurveyConfig
from scene.survey.mesh import Mesh
from scene.survey.messages import EPOCH
from subterra_jax.host.files import replace_file


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes JSON on one line."""
    with replace_file(path) as part:
        part.write_text(json.dumps(content, allow_nan=False) + "\n")


def write_yaml(path: Path, content: dict[str, Any]) -> None:
    """Writes YAML, lists of numbers on one line."""
    with replace_file(path) as part:
        part.write_text(yaml.safe_dump(content, default_flow_style=None, sort_keys=False, width=120))


def write_tum(
    path: Path,
    time: Float[np.ndarray, "n"],
    position: Float[np.ndarray, "n 3"],
    quaternion: Float[np.ndarray, "n 4"] | None,
) -> None:
    """Writes rows of `t x y z qx qy qz qw`, s since the survey's start, m; without a quaternion its part is zero."""
    turns = np.zeros((len(time), 4)) if quaternion is None else quaternion
    with replace_file(path) as part, part.open("w") as file:
        for t, p, q in zip(time, position, turns, strict=True):
            # Seconds and fraction apart: together they would exceed what a float64 resolves.
            whole, micro = divmod(round(t * 1e6), 1_000_000)
            row = [f"{EPOCH + whole}.{micro:06d}", *(f"{v:.6f}" for v in p), *(f"{v:.9f}" for v in q)]
            file.write(" ".join(row) + "\n")


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Writes a binary PLY in float64, with the `part` of each triangle."""
    faces = np.empty(len(mesh.faces), [("n", "u1"), ("v", "<i4", 3), ("part", "u1")])
    faces["n"], faces["v"], faces["part"] = 3, mesh.faces, mesh.part
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment simulated\n"
        f"element vertex {len(mesh.vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nproperty uchar part\nend_header\n"
    )
    with replace_file(path) as part, part.open("wb") as file:
        file.write(header.encode())
        file.write(mesh.vertices.astype("<f8").tobytes())
        file.write(faces.tobytes())


TRUTH_STEP = 0.25  # m between the stations of the truth
DEFINITIONS = {
    "frame": "survey frame, z up; sections lie in the plane of lateral (left, horizontal) and up = tangent x lateral",
    "position": "middle of the smooth section: half its width, half its height; station is arc length along it",
    "width": "largest horizontal distance between the walls in the section, roughness included, pockets excluded",
    "height": "floor to crown on the axis, roughness included; width_smooth and height_smooth leave roughness out",
    "middle": "of the actual section, along lateral and up from position: half way between the walls where the width "
    "is largest, half way from floor to crown",
    "sleepers, rails": "of all tracks; tracks: middles to the left of the axis",
    "things": "what stands or hangs in the bore: boxes by station, left of the axis and above the floor",
    "floor": "ballast surface, straight across, half of height_smooth below position; crossfall: its rise to the left",
    "angle": "rad about position, from lateral towards up",
    "pockets.depth": "along the normal of the smooth section at the pocket's middle",
    "rails.gauge": "between the inner faces of the heads 14 to 16 mm below rail top; rails upright, not inclined",
}


def rounded(values: np.ndarray, digits: int = 6) -> list[Any]:
    """Return an array as lists, rounded."""
    return np.round(np.asarray(values, float), digits).tolist()


def describe_truth(bore: Bore, config: SurveyConfig) -> dict[str, Any]:
    """Return the content of `truth.json`, per docs/formats.md."""
    alignment, section, furniture = bore.alignment, bore.section, bore.furniture
    station = np.arange(0.0, alignment.length + 1e-9, TRUTH_STEP)
    frames = alignment.frames(station)
    actual = section.measure(station)
    return {
        "schema": "subterra.truth/1", "provenance": "simulated", "section_type": bore.section_type, "seed": config.seed,
        "config": {k: v for k, v in asdict(config).items() if k != "out"}, "definitions": DEFINITIONS,
        "length": alignment.length, "station": rounded(station), "position": rounded(frames.position),
        "tangent": rounded(frames.tangent, 9), "width": rounded(actual.width), "height": rounded(actual.height),
        "width_smooth": rounded(section.width(station)), "height_smooth": rounded(section.height(station)),
        "middle": rounded(actual.middle), "crossfall": section.crossfall, "tracks": list(furniture.tracks),
        "things": [thing.describe() for thing in bore.things],
        "rings": {"width": furniture.sizes.ring_width, "station": rounded(furniture.joints)},
        "pockets": _describe_pockets(bore),
        "nails": {"diameter": fur.NAIL_DIAMETER, "depth": fur.NAIL_DEPTH, "count": int(furniture.nails.sum())},
        "sleepers": _describe_sleepers(bore), "rails": _describe_rails(bore, station),
    }  # fmt: skip


def _describe_pockets(bore: Bore) -> list[dict[str, Any]]:
    """Every pocket by growing ring, row and station; `open` is false where it is mortared flush."""
    section, furniture = bore.section, bore.furniture
    out = []
    for side, offset in enumerate((-furniture.sizes.pocket_offset, furniture.sizes.pocket_offset)):
        station = furniture.joints + offset
        frames, smooth = bore.alignment.frames(station), section.smooth(station)
        half = 0.5 * section.height(station)
        for j in np.flatnonzero(furniture.pocketed):
            for r, (first, middle, last) in enumerate(section.shape.rows):
                (y, z), normal = smooth[j, middle], section.shape.normal[middle]
                centre = frames.position[j] + y * frames.lateral[j] + z * frames.up[j]
                out.append({
                    "ring": int(j), "row": r, "side": "left" if 2 * r < fur.N_ROWS else "right",
                    "station": round(float(station[j]), 6), "angle": round(float(np.arctan2(z, y)), 6),
                    "above_floor": round(float(z + half[j]), 6), "position": rounded(centre),
                    "outward": rounded(normal[0] * frames.lateral[j] + normal[1] * frames.up[j], 9),
                    "length": furniture.sizes.pocket_length, "depth": round(float(furniture.depth[j, r, side]), 6),
                    "width": round(float(np.linalg.norm(smooth[j, last] - smooth[j, first])), 6),
                    "open": not bool(furniture.filled[j, r, side]), "nail": bool(furniture.nails[j, r]),
                })  # fmt: skip
    return sorted(out, key=lambda p: (p["ring"], p["row"], p["station"]))


def _describe_sleepers(bore: Bore) -> dict[str, Any]:
    station, tracks, sizes = bore.furniture.sleepers, bore.furniture.tracks, bore.furniture.sizes
    top = bore.furniture.rise - 0.5 * bore.section.height(station)
    frames = bore.alignment.frames(station)
    places = [frames.point(np.full_like(top, track), top) for track in tracks]
    return {
        "station": rounded(np.tile(station, len(tracks))),
        "position": rounded(np.concatenate(places) if places else np.empty((0, 3))),
        "spacing": sizes.sleeper_spacing, "length": sizes.sleeper_length, "top_width": sizes.sleeper_top,
        "bottom_width": fur.SLEEPER_BOTTOM, "height": fur.SLEEPER_HEIGHT, "top_above_floor": bore.furniture.rise,
    }  # fmt: skip


def _describe_rails(bore: Bore, station: np.ndarray) -> dict[str, Any]:
    furniture = bore.furniture
    frames, tracks = bore.alignment.frames(station), furniture.tracks
    top = bore.furniture.rail_top - 0.5 * bore.section.height(station)

    def lines(side: float) -> list[Any]:
        places = [frames.point(np.full_like(top, track + side * furniture.rail_axis), top) for track in tracks]
        return rounded(np.concatenate(places) if places else np.empty((0, 3)))

    return {
        "profile": "CHN60", "gauge": furniture.sizes.gauge, "height": round(furniture.rail_height, 6),
        "pad": furniture.sizes.pad, "axis_offset": furniture.rail_axis, "top_above_floor": furniture.rail_top,
        "inclination": 0.0, "left": lines(1.0), "right": lines(-1.0),
    }  # fmt: skip
