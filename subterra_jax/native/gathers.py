"""Loads of eight triangles or boxes of a relief into vectors, one in each lane.

A gather instruction is slower on many processors than loads of two neighbouring words and shuffles.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typing.templates import signature
from numba.extending import intrinsic

from subterra_jax.lidar3d.cells import STEP_BITS
from subterra_jax.native.lanes import HALF_FLOATS, HALF_INTS, N_HALF

_INT, _WORD = ir.IntType(32), ir.IntType(64)
# Lanes in the order in which shuffles within the halves of a register bring two words of each together.
_ORDER = (0, 1, 4, 5, 2, 3, 6, 7)


def _shuffle(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, order: list[int]) -> ir.Value:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT, len(order)), order))


def _data(context: Any, builder: Any, kind: Any, array: ir.Value) -> ir.Value:
    return context.make_array(kind)(context, builder, array).data


def _numbers(builder: ir.IRBuilder, first: ir.Value, last: ir.Value) -> list[ir.Value]:
    """Return eight consecutive numbers, none beyond the last."""
    numbers = [builder.add(first, _WORD(lane)) for lane in range(N_HALF)]
    return [builder.select(builder.icmp_signed("<", n, last), n, last) for n in numbers]


def _pairs(builder: ir.IRBuilder, pairs: ir.Value, numbers: list[ir.Value]) -> tuple[ir.Value, ir.Value]:
    """Return the first words of eight pairs, and the second."""
    two = ir.VectorType(_WORD, 2)
    quarters = []
    for i in range(0, N_HALF, 2):
        quarter = ir.Constant(two, ir.Undefined)
        for j in range(2):
            word = builder.load(builder.gep(pairs, [numbers[_ORDER[i + j]]]), align=4)
            quarter = builder.insert_element(quarter, word, _INT(j))
        quarters.append(builder.bitcast(quarter, ir.VectorType(_INT, 4)))
    low, high = (_shuffle(builder, quarters[i], quarters[i + 1], list(range(8))) for i in (0, 2))
    first = [0, 2, 8, 10, 4, 6, 12, 14]
    return _shuffle(builder, low, high, first), _shuffle(builder, low, high, [k + 1 for k in first])


@intrinsic
def load_corners(typing: Any, vertex: Any, entry: Any, first: Any, last: Any, first_vertex: Any) -> Any:
    """Load the three vertices of eight triangles, two words each.

    Args:
        typing: Numba's.
        vertex: As in `Relief`, flat.
        entry: As in `Relief`.
        first: Entry of the first triangle.
        last: Entry of the last; lanes beyond it repeat it.
        first_vertex: First vertex of the block.
    """

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        points, codes = (_data(context, builder, sig.args[i], args[i]) for i in range(2))
        pairs = builder.bitcast(points, _WORD.as_pointer())
        low = _WORD((1 << STEP_BITS) - 1)
        corners: list[list[ir.Value]] = [[], [], []]
        for number in _numbers(builder, args[2], args[3]):
            code = builder.zext(builder.load(builder.gep(codes, [number]), align=4), _WORD)
            point = builder.add(args[4], builder.lshr(code, _WORD(2 * STEP_BITS)))
            corners[0].append(point)
            corners[1].append(builder.add(point, builder.and_(builder.lshr(code, _WORD(STEP_BITS)), low)))
            corners[2].append(builder.add(point, builder.and_(code, low)))
        words = [word for numbers in corners for word in _pairs(builder, pairs, numbers)]
        return context.make_tuple(builder, sig.return_type, words)

    return signature(types.UniTuple(HALF_INTS, 6), vertex, entry, *[types.intp] * 3), emit


@intrinsic
def load_rows(typing: Any, box: Any, first: Any, last: Any, side: Any) -> Any:
    """Load one row of eight boxes: its three factors and what to subtract.

    Args:
        typing: Numba's.
        box: As in `Relief`, flat.
        first: First box.
        last: Last box; lanes beyond it repeat it.
        side: Row, 0 to 2.
    """

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        data, four = _data(context, builder, sig.args[0], args[0]), ir.VectorType(ir.FloatType(), 4)
        offset = builder.mul(args[3], _WORD(4))
        rows = []
        for number in _numbers(builder, args[1], args[2]):
            at = builder.gep(data, [builder.add(builder.mul(number, _WORD(12)), offset)])
            rows.append(builder.load(builder.bitcast(at, four.as_pointer()), align=4))
        halves = [_shuffle(builder, rows[i], rows[i + 4], list(range(8))) for i in range(4)]
        mixed = []
        for a, b in ((halves[0], halves[1]), (halves[2], halves[3])):
            mixed += [_shuffle(builder, a, b, [k, k + 8, k + 1, k + 9, k + 4, k + 12, k + 5, k + 13]) for k in (0, 2)]
        columns = []
        for a, b in ((mixed[0], mixed[2]), (mixed[1], mixed[3])):
            columns += [_shuffle(builder, a, b, [k, k + 1, k + 8, k + 9, k + 4, k + 5, k + 12, k + 13]) for k in (0, 2)]
        return context.make_tuple(builder, sig.return_type, columns)

    return signature(types.UniTuple(HALF_FLOATS, 4), box, *[types.intp] * 3), emit
