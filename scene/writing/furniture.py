"""Lineside furniture by standard: what stands in a running tunnel beside the track, as boxes that fit the local bore.

None of it is read from the survey; each kind can be left out, since each is a landmark along the axis.
"""

from collections import Counter

import numpy as np
from jaxtyping import Float

from scene.writing.place import Piece, Place


def furnish(place: Place) -> list[Piece]:
    """Everything the configuration asks for and the bore has room for."""
    config = place.config
    pieces: list[Piece] = []
    if config.walkway:
        pieces += _walkway(place)
    if config.cables:
        pieces += _cables(place)
    if config.third_rail and len(place.track.sleeper_station):
        pieces += _third_rail(place)
    if config.plates:
        pieces += _plates(place)
    if config.lamps:
        pieces += _lamps(place)
    return pieces


def counts(pieces: list[Piece]) -> dict[str, int]:
    """How many boxes of each kind there are."""
    return dict(sorted(Counter(piece.kind for piece in pieces).items()))


def _stations(place: Place, spacing: float, margin: float = 0.3) -> Float[np.ndarray, " k"]:
    return np.arange(spacing / 2, place.bore.length - margin, spacing)


def _stretches(place: Place, spacing: float) -> list[tuple[float, float]]:
    edge = np.append(np.arange(0.0, place.bore.length - spacing / 2, spacing), place.bore.length)
    return list(zip(edge[:-1].tolist(), edge[1:].tolist(), strict=True))


def _walkway(place: Place) -> list[Piece]:
    config, pieces = place.config, []
    least = max(config.gauge, place.track.config.sleeper_length / 2 + 0.05)
    foot, top = -place.track.config.protrusion, config.walkway_height
    rail, half = top + config.handrail_height, config.post_size / 2
    for start, end in _stretches(place, config.post_spacing):
        near, far = place.wall(start, end, top, 1)
        inner = max(near - config.walkway_width, least)
        if near - inner < 0.5:
            continue
        pieces.append(place.box("walkway", "concrete_slab", (start, end), (inner, far + 0.02), (foot, top)))
        wall = min(place.wall(start, end, height, 1)[0] for height in (top, (top + rail) / 2, rail)) - 0.12
        if not config.handrail or place.barred(start, end):
            continue
        middle = (start + end) / 2
        span = (middle - half, middle + half)
        pieces.append(place.box("handrail_post", "galvanised", span, (wall - half, wall + half), (top, rail)))
        tube = (wall - 0.02, wall + 0.02)
        pieces.append(place.box("handrail", "galvanised", (start, end), tube, (rail - 0.04, rail)))
    return pieces


def _cables(place: Place) -> list[Piece]:
    config, pieces = place.config, []
    low, high = min(config.tiers) - 0.1, max(config.tiers) + 0.15
    for station in _stations(place, config.bracket_spacing):
        span = (station - 0.025, station + 0.025)
        near = min(place.wall(station, station, height, -1)[0] for height in np.linspace(low, high, 5))
        if near - config.bracket_length < config.gauge:
            continue
        pieces.append(place.box("bracket", "galvanised", span, (-near, -near + 0.05), (low, high)))
        for tier in config.tiers:
            far = place.wall(station, station, tier, -1)[1]
            arm = (-far, -near + config.bracket_length)
            pieces.append(place.box("bracket_arm", "galvanised", span, arm, (tier - 0.04, tier)))
    for start, end in _stretches(place, 2 * config.bracket_spacing):
        near = min(place.wall(start, end, height, -1)[0] for height in np.linspace(low, high, 5))
        if near - config.bracket_length < config.gauge:
            continue
        middle, half = -near + config.bracket_length / 2, config.cable_diameter / 2
        for tier in config.tiers:
            across = (middle - 2 * half, middle + 2 * half)
            pieces.append(place.box("cable", "cable", (start, end + 0.02), across, (tier, tier + 2 * half)))
    return pieces


def _third_rail(place: Place) -> list[Piece]:
    config, laid, pieces = place.config, place.track.config, []
    middle = -(laid.rail_offset + config.third_rail_offset)
    top = laid.pad_thickness + laid.rail.height + 0.076
    for start, end in _stretches(place, 3.0):
        if place.wall(start, end, top, -1)[0] < -middle + 0.15 or -middle - 0.1 < config.gauge:
            continue
        station = start + 0.5
        pot = (middle - 0.05, middle + 0.05)
        pieces.append(
            place.box("third_rail", "galvanised", (start, end + 0.02), (middle - 0.04, middle + 0.04), (top - 0.1, top))
        )
        pieces.append(
            place.box("insulator", "insulator", (station - 0.05, station + 0.05), pot, (-laid.protrusion, top - 0.1))
        )
        cover = (middle - 0.08, middle + 0.08)
        pieces.append(place.box("third_rail_cover", "cover", (start, end), cover, (top + 0.05, top + 0.07)))
    return pieces


def _plates(place: Place) -> list[Piece]:
    pieces = []
    for station in np.arange(place.config.plate_spacing, place.bore.length - 0.5, place.config.plate_spacing):
        if place.barred(station - 0.3, station + 0.3):
            continue
        near = min(place.wall(station - 0.25, station + 0.25, height, 1)[0] for height in (1.65, 1.95))
        span = (station - 0.25, station + 0.25)
        pieces.append(place.box("hectometre_plate", "plate", span, (near - 0.03, near), (1.65, 1.95)))
    return pieces


def _lamps(place: Place) -> list[Piece]:
    pieces, bore = [], place.bore
    crown = np.array([np.interp(np.pi / 2, bore.angle, radius, period=2 * np.pi) for radius in bore.radius])
    ceiling = bore.position[:, 2] + crown * bore.up[:, 2] - place.track.elevation
    for station in _stations(place, place.config.lamp_spacing):
        height = float(np.interp(station, bore.station, ceiling))
        span = (station - 0.6, station + 0.6)
        pieces.append(place.box("lamp", "lamp", span, (-0.09, 0.09), (height - 0.14, height - 0.04)))
    return pieces
