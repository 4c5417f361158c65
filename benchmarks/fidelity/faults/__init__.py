"""Faults put into a scene: 36 negative controls, which must be noticed, 7 invariances, which must not, local faults.

A fault is one row: kind, size, place, extent. A kind is one function with `fault_kind`; importing this package
registers those of the suite, and a file of a user's own registers more (`--metrics`).
"""

from benchmarks.fidelity.faults import mesh, references, shape
from benchmarks.fidelity.faults.kinds import KINDS, Fault, Kind, Site, fault_kind, put_in

__all__ = ["KINDS", "Fault", "Kind", "Site", "fault_kind", "mesh", "put_in", "references", "shape"]
