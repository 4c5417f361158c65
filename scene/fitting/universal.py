"""Universal rings by standard: each ring is turned to the place of its key segment, and its pockets turn with it.

Ring joints are dowelled and show nothing on the wall. Each radial joint is bolted at the middle of the ring; the bolt
shows a pocket on either side of the joint.

Sources:
    Five segments and a key: Bangkok's first line (tunnelbuilder.com, 1999) and Shanghai's line 13 (J. Tongji Univ.).
    Turns by whole places, so that dowels meet: Autodesk InfraWorks, bored ring tunnels (360° over the places).
    No straight joints from ring to ring: Advances in Civil Engineering 2021, 3606389 (Ningbo, line 2).
    16 places, 67.5° and 22.5°, one bolt a joint, dowels: engineering practice, from memory, not looked up.
"""

import numpy as np
from jaxtyping import Float, Int

N_PLACES = 16  # of the key segment around a ring
PLACE = 2.0 * np.pi / N_PLACES  # rad; the key is as wide
_JOINTS = np.array([0, 3, 6, 9, 12, 15])  # places after which a radial joint follows, from the key's begin
_STEPS = np.array([k for k in range(1, N_PLACES) if not set((_JOINTS + k) % N_PLACES) & set(_JOINTS.tolist())])
_SEGMENT = (0.8, 2.5)  # lengths of segments, m
_FEW = 4


def joints_by_number(names: list[str], station: Float[np.ndarray, " r"]) -> Float[np.ndarray, " j"]:
    """Return the ring joints of a survey of some rings, m: between two that were measured, rings are of one length.

    A ring is taken as measured at its middle. Only names that are whole numbers and grow, or fall, along the tunnel
    tell the rings between: all joints between the first and the last of them, none where the names tell nothing.
    """
    if len(names) < _FEW or not all(name.isdecimal() for name in names):
        return np.empty(0)
    number = np.array([int(name) for name in names])
    number = number if number[-1] > number[0] else -number
    if (np.diff(number) < 1).any():
        return np.empty(0)
    joints = np.interp(np.arange(number[0], number[-1]) + 0.5, number, station)
    width = np.diff(joints)
    return joints if len(width) and _SEGMENT[0] < width.min() and width.max() < _SEGMENT[1] else np.empty(0)


def draw_places(rng: np.random.Generator, count: int) -> Int[np.ndarray, " r"]:
    """Draw the place of each ring's key segment; no radial joint lies in line with one of the ring before."""
    first = rng.integers(N_PLACES, size=1)
    return np.mod(np.cumsum(np.concatenate([first, rng.choice(_STEPS, max(count - 1, 0))])), N_PLACES)[:count]


def radial_joints(seed: int, count: int) -> Float[np.ndarray, "r 6"]:
    """Return the angles of the radial joints of `count` rings, rad.

    The first bolt of the tunnel is drawn too, since nobody says where its designer has put it.
    """
    rng = np.random.default_rng(seed)
    begin = rng.uniform(0.0, PLACE)
    return begin + PLACE * (draw_places(rng, count)[:, None] + _JOINTS)


def place_pockets(
    joint: Float[np.ndarray, " j"], seed: int, offset: float
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Return station, m, and angle, rad, of the pockets at the radial joints of all whole rings between joints, m.

    `offset` is the angle from a radial joint to the middle of a pocket, rad.
    """
    middle = 0.5 * (joint[1:] + joint[:-1])
    angle = radial_joints(seed, len(middle))[..., None] + offset * np.array([-1.0, 1.0])
    return np.broadcast_to(middle[:, None, None], angle.shape).ravel(), angle.ravel()
