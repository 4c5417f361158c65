"""`truth.json`: what a builder is measured against."""

from dataclasses import asdict
from typing import Any

import numpy as np

from scene.survey import furniture as fur
from scene.survey.bore import Bore
from scene.survey.config import SurveyConfig
from scene.survey.furniture import N_ROWS

STEP = 0.25  # m between the stations of the truth
_DEFINITIONS = {
    "frame": "survey frame, z up; sections lie in the plane of lateral (left, horizontal) and up = tangent x lateral",
    "position": "middle of the smooth section: half its width, half its height; station is arc length along it",
    "width": "largest horizontal distance between the walls in the section, roughness included, pockets excluded",
    "height": "floor to crown on the axis, roughness included; width_smooth and height_smooth leave roughness out",
    "middle": "of the actual section, along lateral and up from position: half way between the walls where the width "
    "is largest, half way from floor to crown",
    "floor": "ballast surface, straight across, half of height_smooth below position; crossfall: its rise to the left",
    "angle": "rad about position, from lateral towards up",
    "pockets.depth": "along the normal of the smooth section at the pocket's middle",
    "rails.gauge": "between the inner faces of the heads 14 to 16 mm below rail top; rails upright, not inclined",
}


def _list(values: np.ndarray, digits: int = 6) -> list[Any]:
    return np.round(np.asarray(values, float), digits).tolist()


def describe(bore: Bore, config: SurveyConfig) -> dict[str, Any]:
    """The content of `truth.json`, per docs/formats.md."""
    alignment, section, furniture = bore.alignment, bore.section, bore.furniture
    station = np.arange(0.0, alignment.length + 1e-9, STEP)
    frames = alignment.frames(station)
    actual = section.measure(station)
    return {
        "schema": "subterra.truth/1",
        "provenance": "simulated",
        "section_type": bore.section_type,
        "seed": config.seed,
        "config": {k: v for k, v in asdict(config).items() if k != "out"},
        "definitions": _DEFINITIONS,
        "length": alignment.length,
        "station": _list(station),
        "position": _list(frames.position),
        "tangent": _list(frames.tangent, 9),
        "width": _list(actual.width),
        "height": _list(actual.height),
        "width_smooth": _list(section.width(station)),
        "height_smooth": _list(section.height(station)),
        "middle": _list(actual.middle),
        "crossfall": section.crossfall,
        "rings": {"width": fur.RING_WIDTH, "station": _list(furniture.joints)},
        "pockets": _pockets(bore),
        "nails": {"diameter": fur.NAIL_DIAMETER, "depth": fur.NAIL_DEPTH, "count": int(furniture.nails.sum())},
        "sleepers": _sleepers(bore),
        "rails": _rails(bore, station),
    }


def _pockets(bore: Bore) -> list[dict[str, Any]]:
    """Every place of a pocket by growing ring, row and station; `open` is false where it is mortared flush."""
    section, furniture = bore.section, bore.furniture
    out = []
    for side, offset in enumerate((-fur.POCKET_OFFSET, fur.POCKET_OFFSET)):
        station = furniture.joints + offset
        frames, smooth = bore.alignment.frames(station), section.smooth(station)
        half = 0.5 * section.height(station)
        for j in np.flatnonzero(furniture.pocketed):
            for r, (first, middle, last) in enumerate(section.shape.rows):
                (y, z), normal = smooth[j, middle], section.shape.normal[middle]
                centre = frames.position[j] + y * frames.lateral[j] + z * frames.up[j]
                out.append({
                    "ring": int(j), "row": r, "side": "left" if 2 * r < N_ROWS else "right",
                    "station": round(float(station[j]), 6), "angle": round(float(np.arctan2(z, y)), 6),
                    "above_floor": round(float(z + half[j]), 6), "position": _list(centre),
                    "outward": _list(normal[0] * frames.lateral[j] + normal[1] * frames.up[j], 9),
                    "length": fur.POCKET_LENGTH, "depth": round(float(furniture.depth[j, r, side]), 6),
                    "width": round(float(np.linalg.norm(smooth[j, last] - smooth[j, first])), 6),
                    "open": not bool(furniture.filled[j, r, side]), "nail": bool(furniture.nails[j, r]),
                })  # fmt: skip
    return sorted(out, key=lambda p: (p["ring"], p["row"], p["station"]))


def _sleepers(bore: Bore) -> dict[str, Any]:
    station = bore.furniture.sleepers
    top = fur.SLEEPER_RISE - 0.5 * bore.section.height(station)
    return {
        "station": _list(station),
        "position": _list(bore.alignment.frames(station).point(np.zeros_like(top), top)),
        "spacing": fur.SLEEPER_SPACING, "length": fur.SLEEPER_LENGTH, "top_width": fur.SLEEPER_TOP,
        "bottom_width": fur.SLEEPER_BOTTOM, "height": fur.SLEEPER_HEIGHT, "top_above_floor": fur.SLEEPER_RISE,
    }  # fmt: skip


def _rails(bore: Bore, station: np.ndarray) -> dict[str, Any]:
    frames = bore.alignment.frames(station)
    top = fur.RAIL_TOP - 0.5 * bore.section.height(station)
    return {
        "profile": "CHN60", "gauge": fur.GAUGE, "height": fur.RAIL_HEIGHT, "pad": fur.PAD[2],
        "axis_offset": fur.RAIL_AXIS, "top_above_floor": fur.RAIL_TOP, "inclination": 0.0,
        "left": _list(frames.point(np.full_like(top, fur.RAIL_AXIS), top)),
        "right": _list(frames.point(np.full_like(top, -fur.RAIL_AXIS), top)),
    }  # fmt: skip
