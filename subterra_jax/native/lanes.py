"""Vector types of sixteen or eight numbers for numba, with which a kernel states its SIMD instructions.

LLVM splits the vectors into the registers of the processor. Operators and comparisons work between vectors and
between a vector and a number of its kind; comparisons of floats are false where one is NaN.
"""

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

N_LANES = 16

_FLOAT, _INT, _BOOL = ir.FloatType(), ir.IntType(32), ir.IntType(1)


class Lanes(types.Type):
    """Type of a vector of 16 or 8 elements, held in registers, never in a Python array."""

    def __init__(self, name: str, element: ir.Type, scalar: types.Type, count: int = N_LANES) -> None:
        super().__init__(name=f"{count} lanes of {name}")
        self.vector = ir.VectorType(element, count)
        self.scalar = scalar
        self.count = count


FLOATS = Lanes("float32", _FLOAT, types.float32)
INTS = Lanes("int32", _INT, types.int32)
MASK = Lanes("bool", _BOOL, types.boolean)
# Half as many, for short lists: one register of AVX2.
N_HALF = 8
HALF_FLOATS = Lanes("float32", _FLOAT, types.float32, N_HALF)
HALF_INTS = Lanes("int32", _INT, types.int32, N_HALF)
HALF_MASK = Lanes("bool", _BOOL, types.boolean, N_HALF)
_ALL_FLOATS, _ALL_INTS, _ALL_MASKS = (FLOATS, HALF_FLOATS), (INTS, HALF_INTS), (MASK, HALF_MASK)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, lanes: Lanes) -> None:
        super().__init__(dmm, lanes, lanes.vector)


def _of(kind: Lanes, alike: tuple[Lanes, ...]) -> Lanes:
    """Return the type among some that has as many lanes as another."""
    return next(one for one in alike if one.count == kind.count)


def _widen(builder: ir.IRBuilder, kind: types.Type, value: ir.Value, count: int) -> ir.Value:
    """Return a vector unchanged, or a number repeated in every lane."""
    if isinstance(kind, Lanes):
        return value
    vector = ir.VectorType(value.type, count)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, _INT(0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(_INT, count), [0] * count))


def _define(
    op: Callable[..., Any], kinds: tuple[Lanes, ...], result: tuple[Lanes, ...], emit: Callable[..., ir.Value]
) -> None:
    """Teach numba a binary operator; `emit` gets the builder, the kind and two vectors, and makes one of `result`."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            kind = next((arg for arg in args if isinstance(arg, Lanes)), None)
            if kind not in kinds or any(isinstance(arg, Lanes) and arg is not kind for arg in args):
                return None
            return signature(_of(kind, result or (kind,)), *(arg if arg is kind else kind.scalar for arg in args))

    infer_global(op)(Template)
    for kind in kinds:

        def lower(context: Any, builder: Any, sig: Any, args: Any, kind: Lanes = kind) -> ir.Value:
            wide = (_widen(builder, *pair, kind.count) for pair in zip(sig.args, args, strict=True))
            return emit(builder, kind, *wide)

        for pair in ((kind, kind), (kind, kind.scalar), (kind.scalar, kind)):
            lower_builtin(op, *pair)(lower)


def _comparison(sign: str) -> Callable[..., ir.Value]:
    def emit(builder: ir.IRBuilder, kind: Lanes, a: ir.Value, b: ir.Value) -> ir.Value:
        return builder.fcmp_ordered(sign, a, b) if kind in _ALL_FLOATS else builder.icmp_signed(sign, a, b)

    return emit


_define(operator.add, _ALL_FLOATS, (), lambda builder, _, a, b: builder.fadd(a, b))
_define(operator.sub, _ALL_FLOATS, (), lambda builder, _, a, b: builder.fsub(a, b))
_define(operator.mul, _ALL_FLOATS, (), lambda builder, _, a, b: builder.fmul(a, b))
_define(operator.truediv, _ALL_FLOATS, (), lambda builder, _, a, b: builder.fdiv(a, b))
_define(operator.and_, _ALL_INTS + _ALL_MASKS, (), lambda builder, _, a, b: builder.and_(a, b))
_define(operator.or_, _ALL_INTS + _ALL_MASKS, (), lambda builder, _, a, b: builder.or_(a, b))
_define(operator.lshift, _ALL_INTS, (), lambda builder, _, a, b: builder.shl(a, b))
for _op, _sign in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _define(_op, _ALL_FLOATS + _ALL_INTS, _ALL_MASKS, _comparison(_sign))
_define(operator.eq, _ALL_FLOATS + _ALL_INTS, _ALL_MASKS, _comparison("=="))


def _call(builder: ir.IRBuilder, name: str, result: ir.Type, args: list[ir.Value]) -> ir.Value:
    """Call one of LLVM's own functions."""
    function = builder.module.globals.get(name)
    if function is None:
        function = ir.Function(builder.module, ir.FunctionType(result, [arg.type for arg in args]), name)
    return builder.call(function, args)


@intrinsic
def where(typing: Any, mask: Any, then: Any, otherwise: Any) -> Any:
    """Select, lane by lane, `then` where the mask is set, else `otherwise`; one of the two may be a number."""
    kind = then if isinstance(then, Lanes) else otherwise
    sig = signature(kind, _of(kind, _ALL_MASKS), *(arg if arg is kind else kind.scalar for arg in (then, otherwise)))

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        wide = (_widen(builder, *pair, kind.count) for pair in zip(sig.args[1:], args[1:], strict=True))
        return builder.select(args[0], *wide)

    return sig, emit


@intrinsic
def magnitude(typing: Any, values: Any) -> Any:
    """Return absolute values."""
    return signature(values, values), lambda context, builder, sig, args: _call(
        builder, f"llvm.fabs.v{values.count}f32", values.vector, args
    )


@intrinsic
def fma(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a · b + c, rounded once where the processor can; at least one is a vector, the others may be numbers."""
    kind = next(arg for arg in (a, b, c) if isinstance(arg, Lanes))

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        wide = [_widen(builder, *pair, kind.count) for pair in zip(sig.args, args, strict=True)]
        return _call(builder, f"llvm.fmuladd.v{kind.count}f32", kind.vector, wide)

    return signature(kind, *(arg if arg is kind else kind.scalar for arg in (a, b, c))), emit


@intrinsic
def negative(typing: Any, values: Any) -> Any:
    """Return floats with the other sign."""
    return signature(values, values), lambda context, builder, sig, args: builder.fneg(args[0])


@intrinsic
def repeat(typing: Any, value: Any) -> Any:
    """Return a vector of eight that has a float or an integer in every lane."""
    kind = HALF_FLOATS if value == types.float32 else HALF_INTS
    return signature(kind, kind.scalar), lambda context, builder, sig, args: _widen(builder, value, args[0], kind.count)


def _extreme(which: str) -> Any:
    @intrinsic
    def extreme(typing: Any, values: Any) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            name = f"llvm.vector.reduce.f{which}.v{values.count}f32"
            function = builder.module.globals.get(name)
            if function is None:
                function = ir.Function(builder.module, ir.FunctionType(_FLOAT, [values.vector]), name)
            return builder.call(function, args, fastmath=("nnan",))

        return signature(types.float32, values), emit

    return extreme


# Least and greatest of the numbers in a vector, none of which is NaN.
lowest, highest = _extreme("min"), _extreme("max")


@intrinsic
def first_set(typing: Any, mask: Any) -> Any:
    """Return the number of the first lane that is set; one of them must be."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        word = builder.zext(builder.bitcast(args[0], ir.IntType(mask.count)), _INT)
        return builder.cttz(word, _BOOL(1))

    return signature(types.int32, mask), emit


@intrinsic
def pick(typing: Any, values: Any, lane: Any) -> Any:
    """Return the number in a lane."""
    return signature(values.scalar, values, types.intp), lambda context, builder, sig, args: builder.extract_element(
        *args
    )


@intrinsic
def as_floats(typing: Any, values: Any) -> Any:
    """Return integers as floats."""
    kind = _of(values, _ALL_FLOATS)
    return signature(kind, values), lambda context, builder, sig, args: builder.sitofp(args[0], kind.vector)


@intrinsic
def root(typing: Any, values: Any) -> Any:
    """Return square roots."""
    return signature(FLOATS, FLOATS), lambda context, builder, sig, args: _call(
        builder, f"llvm.sqrt.v{N_LANES}f32", FLOATS.vector, args
    )


@intrinsic
def least(typing: Any, values: Any) -> Any:
    """Return the least of 16 integers."""
    return signature(types.int32, INTS), lambda context, builder, sig, args: _call(
        builder, f"llvm.vector.reduce.smin.v{N_LANES}i32", _INT, args
    )


@intrinsic
def lane_numbers(typing: Any) -> Any:
    """Return the number of each lane, 0 to 15."""
    return signature(INTS), lambda context, builder, sig, args: ir.Constant(INTS.vector, list(range(N_LANES)))


@intrinsic
def following(typing: Any, values: Any) -> Any:
    """Shift values one lane down; the last lane keeps its own."""
    order = ir.Constant(ir.VectorType(_INT, N_LANES), [*range(1, N_LANES), N_LANES - 1])
    return signature(values, values), lambda context, builder, sig, args: builder.shuffle_vector(
        args[0], args[0], order
    )


@intrinsic
def bits(typing: Any, value: Any) -> Any:
    """Return the bits of floats as integers; for floats of at least 0 both sort alike."""
    result = INTS if value is FLOATS else types.int32
    return signature(result, value), lambda context, builder, sig, args: builder.bitcast(
        args[0], INTS.vector if value is FLOATS else _INT
    )


@intrinsic
def from_bits(typing: Any, value: Any) -> Any:
    """Return the float that has the bits of an integer."""
    return signature(types.float32, types.int32), lambda context, builder, sig, args: builder.bitcast(args[0], _FLOAT)


def _address(context: Any, builder: Any, kind: Any, array: ir.Value, index: ir.Value) -> ir.Value:
    """Return the address of 16 elements of a flat contiguous array."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), FLOATS.vector.as_pointer())


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Load 16 consecutive elements of a flat contiguous float32 array; bounds are not checked."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return builder.load(_address(context, builder, sig.args[0], args[0], args[1]), align=4)

    return signature(FLOATS, array, types.intp), emit


@intrinsic
def load_some(typing: Any, array: Any, index: Any, mask: Any) -> Any:
    """Load as `load`, but lanes outside the mask are 0 and their memory is not read."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        address = _address(context, builder, sig.args[0], args[0], args[1])
        zero = ir.Constant(FLOATS.vector, None)
        return _call(builder, f"llvm.masked.load.v{N_LANES}f32.p0", FLOATS.vector, [address, _INT(4), args[2], zero])

    return signature(FLOATS, array, types.intp, MASK), emit


@intrinsic
def store(typing: Any, array: Any, index: Any, values: Any) -> Any:
    """Write 16 consecutive elements of a flat contiguous float32 array; bounds are not checked."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        builder.store(args[2], _address(context, builder, sig.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return signature(types.void, array, types.intp, FLOATS), emit
