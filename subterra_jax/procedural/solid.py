"""The three-dimensional form of a drawn bore, of which its plan is the cut."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from subterra_jax.procedural.bore import Bore
from subterra_jax.procedural.fixtures import Boxes
from subterra_jax.procedural.geometry import Alignment
from subterra_jax.tunnel.shell import SPACING, Shell, ShellLining, make_bricks

_INTO = 0.5  # m by which a box reaches into the wall, so that no gap is seen behind it
_PIECE = 2.0  # m, longest piece of a bench: it follows the bends by straight pieces
_ROUGH = 0.11  # m: a kind whose wall is known more finely has triangles as fine


def make_shell(
    bore: Bore, alignment: Alignment, elevation: Float[np.ndarray, " n"], variants: tuple[str, ...]
) -> Shell:
    """Return the bore in three dimensions, with the linings of a plan.

    Args:
        alignment: Its centreline in plan.
        elevation: Height of the floor at the centreline's stations, m.
        variants: Of `built`, `bare` and `smooth`.
    """
    station = bore.grid.station
    slope = np.interp(station, alignment.station, np.gradient(elevation, alignment.station))
    position = np.column_stack(
        [alignment.position(station), np.interp(station, alignment.station, elevation) + bore.middle]
    )
    tangent = np.column_stack([alignment.tangent(station), slope])
    around = bore.grid.girth.max() / len(bore.grid.angle)
    own = _bricks(bore.box, bore, alignment, elevation)
    nothing = np.zeros((0, 5)), np.zeros((0, own.shape[1]))
    extra = np.concatenate([_bricks(bore.furniture, bore, alignment, elevation), _benches(bore, alignment, elevation)])
    linings = {
        "built": ShellLining(np.concatenate([bore.pocket, bore.niche, bore.recess]), np.concatenate([own, extra])),
        "bare": ShellLining(np.concatenate([bore.pocket, bore.niche]), own),
        "smooth": ShellLining(*nothing, radius=bore.radius(smooth=True) if "smooth" in variants else None),
    }
    return Shell(
        station=station,
        position=position,
        tangent=tangent / np.linalg.norm(tangent, axis=1, keepdims=True),
        angle=bore.grid.angle,
        radius=bore.radius(),
        section=np.minimum(bore.outline, bore.floor),
        track=own[:0],
        linings={name: linings[name] for name in variants},
        spacing=(bore.kind.step, around) if bore.kind.step < _ROUGH else SPACING,
    )


def _bricks(
    boxes: Boxes, bore: Bore, alignment: Alignment, elevation: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "k 13"]:
    """Return boxes at the walls as bricks."""
    depth = boxes.out + _INTO
    return _place(
        0.5 * (boxes.start + boxes.end),
        boxes.side * (boxes.face + 0.5 * depth),
        0.5 * (boxes.low + boxes.high),
        0.5 * np.column_stack([boxes.end - boxes.start, depth, boxes.high - boxes.low]),
        alignment,
        elevation,
    )


def _benches(bore: Bore, alignment: Alignment, elevation: Float[np.ndarray, " n"]) -> Float[np.ndarray, "k 13"]:
    """Return walkways and troughs as bricks end to end."""
    ends = np.linspace(0.0, alignment.length, int(alignment.length / _PIECE) + 2)
    middle, half = 0.5 * (ends[1:] + ends[:-1]), 0.5 * (ends[1] - ends[0])
    parts = [np.zeros((0, 13))]
    for bench in bore.benches:
        depth = bench.width + _INTO
        edge = bore.bench_edge(bench)
        size = np.broadcast_to([half, 0.5 * depth, 0.5 * bench.top], (len(middle), 3))
        lateral = np.full(len(middle), bench.side * (edge + 0.5 * depth))
        parts.append(_place(middle, lateral, np.full(len(middle), 0.5 * bench.top), size, alignment, elevation))
    return np.concatenate(parts)


def _place(
    station: np.ndarray, lateral: np.ndarray, height: np.ndarray, half: np.ndarray, alignment: Alignment,
    elevation: np.ndarray,
) -> Float[np.ndarray, "k 13"]:  # fmt: skip
    floor = np.interp(station, alignment.station, elevation)
    centre = np.column_stack([alignment.offset(station, lateral), floor + height])
    return make_bricks(centre, alignment.heading(station), half)
