"""`truth.json` of a survey whose truth is a tunnel file."""

from dataclasses import asdict
from typing import Any

import numpy as np
from jaxtyping import Float

from scene.survey.config import SurveyConfig
from scene.survey.given import GivenBore
from scene.survey.mesh import Part, box_mesh
from scene.survey.write import DEFINITIONS, TRUTH_STEP, rounded

_POCKET = (0.45, 0.35)  # m: recesses up to this size, along and around, and up to this depth are pockets, others niches
_LEVELS = 200  # heights at which the width of a section is looked for
_HEAD = 0.03  # m below the highest middle of a rail's box, within which a box is a head
_ABOVE_FLOOR, _OF_CROWN = 0.05, 0.5  # m above the floor and below the crown, between which walls are walls


def describe_given(bore: GivenBore, config: SurveyConfig) -> dict[str, Any]:
    """Return the content of `truth.json`, per docs/formats.md."""
    station = np.arange(0.0, bore.alignment.length + 1e-9, TRUTH_STEP)
    frames = bore.alignment.frames(station)
    width, height, middle = measure_sections(bore, station)
    sleepers = [k for k in range(bore.track) if bore.part_of(k) is Part.SLEEPER]
    tops = bore.brick[sleepers, :3] + bore.brick[sleepers, 9:12]
    pockets, niches = _describe_recesses(bore)
    settings = {k: v for k, v in asdict(config).items() if k not in ("out", "truth", "truth_file", "lining")}
    return {
        "schema": "subterra.truth/1",
        "provenance": "simulated",
        "section_type": "given",
        "seed": config.seed,
        "config": settings | {"truth_file": {"tunnel": bore.name, "lining": bore.lining, "sha256": bore.digest}},
        "definitions": {name: DEFINITIONS[name] for name in ("frame", "width", "height", "middle", "angle")}
        | {
            "position": "middle of the mean section: half its width, half its height; station is arc length along it",
            "width_smooth": "median of width along the bore; height_smooth of height",
            "pockets.depth": "along the normal of the wall at the pocket's middle",
            "things": "boxes and niches by station, left of the axis and above the floor",
        },
        "length": bore.alignment.length,
        "station": rounded(station),
        "position": rounded(frames.position),
        "tangent": rounded(frames.tangent, 9),
        "width": rounded(width),
        "height": rounded(height),
        "width_smooth": rounded(np.full_like(width, np.median(width))),
        "height_smooth": rounded(np.full_like(height, np.median(height))),
        "middle": rounded(middle),
        "crossfall": 0.0,
        "aside": rounded(np.zeros_like(station)),
        "tracks": [0.0] if bore.track else [],
        "things": [*_describe_boxes(bore), *niches],
        "cutting": None,
        "dark": None,
        "strays": bore.strays,
        "rings": {"width": bore.ring_pitch, "station": rounded(bore.at(bore.ring_joint))},
        "pockets": pockets,
        "nails": {"count": 0},
        "sleepers": {
            "station": rounded(bore.at(bore.box_stations()[sleepers])),
            "position": rounded(tops),
            "top_above_floor": _rise(bore, tops, sleepers),
        },
        "rails": {"gauge": _gauge(bore)},
    }


def measure_sections(
    bore: GivenBore, station: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n 2"]]:
    """Return width, height and the middle of the wall, recesses left out, at stations by arc length, m."""
    rows, n = bore.section.station, len(bore.sheet.station)
    frames = bore.alignment.frames(rows)
    offset = bore.sheet.vertex - frames.position[:, None]
    y = np.einsum("nki,ni->nk", offset, frames.lateral)
    z = np.einsum("nki,ni->nk", offset, frames.up)
    width, across = np.empty(n), np.empty(n)
    for k in range(n):
        top = int(np.argmax(z[k]))
        level = np.linspace(z[k].min() + _ABOVE_FLOOR, z[k, top] - _OF_CROWN, _LEVELS)
        # From the seam in the floor up the left wall to the crown, and down the right one.
        left = np.interp(level, np.maximum.accumulate(z[k, : top + 1]), y[k, : top + 1])
        right = np.interp(level, np.maximum.accumulate(z[k, : top - 1 : -1]), y[k, : top - 1 : -1])
        widest = int(np.argmax(left - right))
        width[k], across[k] = left[widest] - right[widest], 0.5 * (left[widest] + right[widest])
    columns = (width, bore.section.value, across, bore.section.middle)
    out = [np.interp(station, rows, values) for values in columns]
    return out[0], out[1], np.column_stack(out[2:])


def _describe_recesses(bore: GivenBore) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return pockets and niches; a niche's box reaches from its mouth into the wall."""
    pockets, niches = [], []
    at = bore.at(bore.pocket[:, 0])
    frames = bore.alignment.frames(at)
    half = 0.5 * bore.section.height(at)
    for k, (recess, row) in enumerate(zip(bore.recesses, bore.pocket, strict=True)):
        centre = bore.sheet.at(np.array([np.mean(recess.row)]), np.array([np.mean(recess.column)]))[0, 0]
        left, above = frames.lateral[k] @ (centre - frames.position[k]), frames.up[k] @ (centre - frames.position[k])
        outward = recess.outward / row[4]
        if row[2] <= _POCKET[0] and row[3] <= _POCKET[0] and row[4] <= _POCKET[1]:
            pockets.append({
                "station": round(float(at[k]), 6), "angle": round(float(np.arctan2(above, left)), 6),
                "above_floor": round(float(above + half[k]), 6), "position": rounded(centre),
                "outward": rounded(outward, 9), "length": round(float(row[2]), 6),
                "depth": round(float(row[4]), 6), "width": round(float(row[3]), 6), "open": True, "nail": False,
            })  # fmt: skip
            continue
        sides = sorted((left, left + np.copysign(row[4], left)))
        box = {"start": at[k] - 0.5 * row[2], "end": at[k] + 0.5 * row[2], "right": sides[0], "left": sides[1]}
        box |= {"low": above + half[k] - 0.5 * row[3], "high": above + half[k] + 0.5 * row[3]}
        niches.append({"kind": "niche", **{name: round(float(value), 6) for name, value in box.items()}})
    return sorted(pockets, key=lambda pocket: float(pocket["station"])), niches


def _describe_boxes(bore: GivenBore) -> list[dict[str, Any]]:
    """Return the boxes that are no track."""
    out = []
    at = bore.at(bore.box_stations())
    frames, half = bore.alignment.frames(at), 0.5 * bore.section.height(at)
    for k in range(bore.track, len(bore.brick)):
        corner = box_mesh(bore.brick[k, :3], bore.brick[k, 3:12].reshape(3, 3), bore.brick[k, 12], Part.THING, 0.0)
        offset = corner.vertices - frames.position[k]
        along, left, above = (offset @ axis for axis in (frames.tangent[k], frames.lateral[k], frames.up[k]))
        box = {"start": at[k] + along.min(), "end": at[k] + along.max(), "right": left.min(), "left": left.max()}
        box |= {"low": above.min() + half[k], "high": above.max() + half[k]}
        out.append({"kind": "furniture", **{name: round(float(value), 6) for name, value in box.items()}})
    return out


def _rise(bore: GivenBore, tops: Float[np.ndarray, "k 3"], sleepers: list[int]) -> float:
    """Return the median height of the sleepers' tops above the floor, m; 0 without sleepers."""
    if not sleepers:
        return 0.0
    at = bore.at(bore.box_stations()[sleepers])
    frames = bore.alignment.frames(at)
    above = np.einsum("ki,ki->k", tops - frames.position, frames.up) + 0.5 * bore.section.height(at)
    return round(float(np.median(above)), 6)


def _gauge(bore: GivenBore) -> float | None:
    """Return the distance of the inner faces of the rails' heads, their highest boxes, m; `None` without rails."""
    rails = [k for k in range(bore.track) if bore.part_of(k) is Part.RAIL]
    if not rails:
        return None
    frames = bore.alignment.frames(bore.at(bore.box_stations()[rails]))
    offset = bore.brick[rails, :3] - frames.position
    left, above = np.einsum("ki,ki->k", offset, frames.lateral), np.einsum("ki,ki->k", offset, frames.up)
    heads = above > above.max() - _HEAD
    half = np.linalg.norm(bore.brick[rails, 6:9], axis=1)[heads]
    sides = [
        float(np.median(left[heads][side * left[heads] > 0] - side * half[side * left[heads] > 0])) for side in (1, -1)
    ]
    return round(sides[0] - sides[1], 6)
