"""Custom calls of XLA by plain pointers, without a C compiler: a handler shares the rows of a call among threads.

The threads wait for jobs at a pipe as long as the process lives: on virtual machines, to start one takes longer than
its job.
"""

import os
import threading
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
_read = types.ExternalFunction("read", signature(types.intp, types.int32, types.intp, types.intp))
_write = types.ExternalFunction("write", signature(types.intp, types.int32, types.intp, types.intp))
_yield = types.ExternalFunction("sched_yield", signature(types.int32))
# What a job is: addresses of results and operands, rows from and to, and whether it is done.
_RESULTS, _OPERANDS, _FROM, _TO, _DONE, _JOB = range(6)


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


@intrinsic
def _fence(typing: Any) -> Any:
    """All that was written before is seen by those who see what is written after."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return signature(types.void), emit


# Of each kernel: `handler_of` puts its own in their place.
work, pipe = None, None


@no_type_check
def _serve(jobs):
    address = np.zeros(1, np.int64)
    while True:
        if _read(types.int32(jobs), address.ctypes.data, 8) == 8:
            job = carray(_addresses_at(address[0]), (_JOB,))
            work(job[_RESULTS], job[_OPERANDS], job[_FROM], job[_TO])
            _fence()
            job[_DONE] = 1


@no_type_check
def _answer(results, operands, _, _length, _status):
    sizes = _ints_at(_addresses_at(operands)[0])
    rows, n = sizes[0], sizes[1]
    jobs, address = np.zeros((n, _JOB), np.int64), np.zeros(1, np.int64)
    for k in range(1, n):
        jobs[k, _RESULTS], jobs[k, _OPERANDS] = results, operands
        jobs[k, _FROM], jobs[k, _TO] = rows * k // n, rows * (k + 1) // n
        address[0] = jobs.ctypes.data + 8 * _JOB * k
        _write(types.int32(_addresses_at(pipe())[1]), address.ctypes.data, 8)
    work(results, operands, 0, rows // n)
    for k in range(1, n):
        while jobs[k, _DONE] == 0:
            _yield()
    _fence()


def _address_of(symbol: str) -> Any:
    """Return a compiled function that gives an address, which machine code on disk leaves open."""

    @intrinsic
    def address(typing: Any) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            kind = ir.FunctionType(ir.IntType(64), [ir.IntType(64)])
            return builder.ptrtoint(cgutils.get_or_insert_function(builder.module, kind, symbol), ir.IntType(64))

        return signature(types.intp), emit

    return address


def handler_of(work: Callable[..., None], name: str, helpers: int, cache: bool) -> tuple[Any, ...]:
    """Return a handler of XLA's, and what its threads need; the first operand of a call is as `sizes_of` makes it.

    Args:
        work: Compiled function of the addresses of a call's results and operands, and of two rows: from, to.
        name: Name of the kernel; must be unique.
        helpers: Threads besides those that call; at least one.
        cache: Keep the machine code on disk.
    """

    def own(function: Callable[..., Any], **others: Any) -> Callable[..., Any]:
        # Numba numbers functions of one name anew in every process: code of two of them on disk would be mixed up. And
        # it takes a closure for another one in every process.
        made = FunctionType(function.__code__, {**globals(), **others})
        made.__name__ = made.__qualname__ = name + function.__name__
        return made

    symbol, pipe = f"{name}_pipe", np.array(os.pipe())
    binding.add_symbol(symbol, pipe.ctypes.data)
    serve = cfunc(types.void(types.intp), cache=cache)(own(_serve, work=work))
    for _ in range(helpers):
        threading.Thread(target=serve.ctypes, args=(pipe[0],), daemon=True).start()
    return cfunc(_HANDLER, cache=cache)(own(_answer, work=work, pipe=_address_of(symbol))), serve, pipe


def sizes_of(rows: int, threads: int, arguments: tuple[Any, ...]) -> np.ndarray:
    """Return the first operand of a call: its rows, threads at most, and the length of each argument."""
    return np.array([rows, max(1, threads), *(array.size for array in arguments)], np.int32)
