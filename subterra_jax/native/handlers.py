"""The kernels as custom calls of XLA: what they read from a frame, and the machine code that XLA calls."""

from typing import Any, no_type_check

import jax
from numba import cfunc, njit, types

from subterra_jax.native.clearance import clearance_rows
from subterra_jax.native.frames import argument, capsule, floats, ints, result, size, wants_work
from subterra_jax.native.keeping import code_kept
from subterra_jax.native.scan import scan_rows
from subterra_jax.native.threads import shared_out

SCAN, CLEARANCE = "subterra_scan", "subterra_clearance"
# Machine code lives as long as the object that made it.
_alive: list[Any] = []


@njit
@no_type_check
def _scan(frame, begin, end):
    """Rows of a scan call: first, wanted, position, heading, box, wall, turn, limit, n_scan to ranges."""
    wall = argument(frame, 5)
    scan_rows(
        begin,
        end,
        ints(argument(frame, 0)),
        ints(argument(frame, 1)),
        floats(argument(frame, 2)),
        floats(argument(frame, 3)),
        floats(argument(frame, 4)),
        floats(wall),
        size(wall, 2),
        floats(argument(frame, 6)),
        floats(argument(frame, 7))[0],
        ints(argument(frame, 8))[0],
        floats(result(frame, 0)),
    )


@njit
@no_type_check
def _clearance(frame, begin, end):
    """Rows of a clearance call: first, position, box, wall, reach, n_contact to distances."""
    wall = argument(frame, 3)
    clearance_rows(
        begin,
        end,
        ints(argument(frame, 0)),
        floats(argument(frame, 1)),
        floats(argument(frame, 2)),
        floats(wall),
        size(wall, 2),
        floats(argument(frame, 4))[0],
        ints(argument(frame, 5))[0],
        floats(result(frame, 0)),
    )


# About 20 µs of work at a time, which is what waking a thread costs.
_scan_all = shared_out(_scan, 32, "subterra_scan_helper")
_clearance_all = shared_out(_clearance, 256, "subterra_clearance_helper")


@no_type_check
def _scan_handler(frame):
    """The custom call that scans."""
    if wants_work(frame):
        _scan_all(frame, size(result(frame, 0), 0))
    return 0


@no_type_check
def _clearance_handler(frame):
    """The custom call that measures clearances."""
    if wants_work(frame):
        _clearance_all(frame, size(result(frame, 0), 0))
    return 0


with code_kept() as kept:
    for _name, _handler in ((SCAN, _scan_handler), (CLEARANCE, _clearance_handler)):
        _alive.append(cfunc(types.intp(types.intp), cache=kept)(_handler))
        jax.ffi.register_ffi_target(_name, capsule(_alive[-1].address), platform="cpu")
