"""Custom calls of XLA by plain pointers, without a C compiler: a handler shares the rows of a call among threads."""

from collections.abc import Callable
from types import FunctionType
from typing import Any, no_type_check

import numpy as np
from llvmlite import binding, ir
from numba import carray, cfunc, njit, types
from numba.core import cgutils
from numba.core.typing.templates import signature
from numba.extending import intrinsic

# XLA's interface "status returning, unified": results, operands, and three things that these calls do not use.
API_VERSION = 3
_HANDLER = types.void(*[types.intp] * 5)
_create = types.ExternalFunction("pthread_create", signature(types.int32, *[types.intp] * 4))
_join = types.ExternalFunction("pthread_join", signature(types.int32, *[types.intp] * 2))


def _at(kind: types.Type) -> Any:
    """Return a compiled function that takes an address for a pointer to numbers."""

    @intrinsic
    def at(typing: Any, address: Any) -> Any:
        pointer = types.CPointer(kind)
        return signature(pointer, types.intp), lambda context, builder, sig, args: builder.inttoptr(
            args[0], context.get_value_type(pointer)
        )

    return at


_addresses_at, _ints_at, _floats_at = _at(types.intp), _at(types.int32), _at(types.float32)


@njit
@no_type_check
def argument(operands, i):
    """Return the i-th argument as a flat array of float32; `.view` gives other numbers of 32 bits."""
    sizes = _ints_at(_addresses_at(operands)[0])
    return carray(_floats_at(_addresses_at(operands)[i + 1]), (sizes[i + 2],))


@njit
@no_type_check
def result(address, size):
    """Return the only result as a flat array, as `argument`."""
    return carray(_floats_at(address), (size,))


@njit
@no_type_check
def result_of_many(addresses, i, size):
    """Return the i-th of several results as a flat array, as `argument`."""
    return carray(_floats_at(_addresses_at(addresses)[i]), (size,))


# Of each kernel: `handler_of` puts its own in their place.
work, part = None, None


@no_type_check
def _do_part(job):
    results, operands, begin, end = carray(_addresses_at(job), (4,))
    work(results, operands, begin, end)
    return 0


@no_type_check
def _answer(results, operands, _, _length, _status):
    sizes = _ints_at(_addresses_at(operands)[0])
    rows, n = sizes[0], sizes[1]
    jobs, threads = np.empty((n, 4), np.int64), np.zeros(n, np.int64)
    for k in range(1, n):
        jobs[k, 0], jobs[k, 1], jobs[k, 2], jobs[k, 3] = results, operands, rows * k // n, rows * (k + 1) // n
        if _create(threads.ctypes.data + 8 * k, 0, part(), jobs.ctypes.data + 32 * k) != 0:
            threads[k] = 0
    work(results, operands, 0, rows // n)
    for k in range(1, n):
        if threads[k] != 0:
            _join(threads[k], 0)
        else:
            work(results, operands, jobs[k, 2], jobs[k, 3])


def _address_of(symbol: str) -> Any:
    """Return a compiled function that gives the address of a C function."""

    @intrinsic
    def address(typing: Any) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            kind = ir.FunctionType(ir.IntType(64), [ir.IntType(64)])
            return builder.ptrtoint(cgutils.get_or_insert_function(builder.module, kind, symbol), ir.IntType(64))

        return signature(types.intp), emit

    return address


def handler_of(work: Callable[..., None], name: str, cache: bool) -> tuple[Any, Any]:
    """Return a handler of XLA's, and what its threads run; the first operand of a call is as `sizes_of` makes it.

    Args:
        work: Compiled function of the addresses of a call's results and operands, and of two rows: from, to.
        name: Name of the kernel; must be unique.
        cache: Keep the machine code on disk.
    """

    def own(function: Callable[..., Any], **others: Any) -> Callable[..., Any]:
        # Numba numbers functions of one name anew in every process: code of two of them on disk would be mixed up. And
        # it takes a closure for another one in every process.
        made = FunctionType(function.__code__, {**globals(), **others})
        made.__name__ = made.__qualname__ = name + function.__name__
        return made

    symbol = f"{name}_part"
    do_part = cfunc(types.intp(types.intp), cache=cache)(own(_do_part, work=work))
    binding.add_symbol(symbol, do_part.address)
    return cfunc(_HANDLER, cache=cache)(own(_answer, work=work, part=_address_of(symbol))), do_part


def sizes_of(rows: int, threads: int, arguments: tuple[Any, ...]) -> np.ndarray:
    """Return the first operand of a call: its rows, threads at most, and the length of each argument."""
    return np.array([rows, max(1, threads), *(array.size for array in arguments)], np.int32)
