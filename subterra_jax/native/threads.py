"""Custom calls of XLA by plain pointers, without a C compiler: a handler shares the rows of a call among threads.

The threads wait for jobs at a file as long as the process lives: on virtual machines, to start one takes longer than
its job.
"""

import os
import sys
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
# Words of the job that threads share: addresses of results and operands, rows, rows of a chunk, rows done, the state,
# whether there is a job, and the two ends of that file. The state counts jobs above and rows taken below `_ROW_BITS`.
_RESULTS, _OPERANDS, _ROWS, _CHUNK, _DONE, _STATE, _BUSY, _READ, _WRITE, _WORDS = range(10)
_ROW_BITS, _ALL_TAKEN = 32, (1 << 32) - 1


def _at(kind: types.Type) -> Any:
    """Return a compiled function that takes an address for a pointer to numbers."""

    @intrinsic
    def at(typing: Any, address: Any) -> Any:
        pointer = types.CPointer(kind)
        return signature(pointer, types.intp), lambda context, builder, sig, args: builder.inttoptr(
            args[0], context.get_value_type(pointer)
        )

    return at


addresses_at, _ints_at, _floats_at = _at(types.intp), _at(types.int32), _at(types.float32)


@njit
@no_type_check
def argument(operands, i):
    """Return the i-th argument as a flat array of float32; `.view` gives other numbers of 32 bits."""
    sizes = _ints_at(addresses_at(operands)[0])
    return carray(_floats_at(addresses_at(operands)[i + 1]), (sizes[i + 3],))


@njit
@no_type_check
def result(address, size):
    """Return the result at an address as a flat array, as `argument`; several are at `addresses_at` the one given."""
    return carray(_floats_at(address), (size,))


@intrinsic
def _exchange(typing: Any, address: Any, old: Any, new: Any) -> Any:
    """Write a number over an old one if it still stands there, at once for all threads; return what stood there."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        pointer = builder.inttoptr(args[0], ir.IntType(64).as_pointer())
        return builder.extract_value(builder.cmpxchg(pointer, args[1], args[2], "seq_cst", "seq_cst"), 0)

    return signature(types.intp, types.intp, types.intp, types.intp), emit


@intrinsic
def _add(typing: Any, address: Any, number: Any) -> Any:
    """Add to a number, at once for all threads; return what it was before."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        pointer = builder.inttoptr(args[0], ir.IntType(64).as_pointer())
        return builder.atomic_rmw("add", pointer, args[1], "seq_cst")

    return signature(types.intp, types.intp, types.intp), emit


# Of each kernel: `handler_of` puts its own in their place.
work, take, job = None, None, None


@no_type_check
def _take(at):
    """Take chunks of the job's rows until all are taken.

    Whoever takes one sees the job that it is of: the state has not changed since that was read.
    """
    words = carray(addresses_at(at), (_WORDS,))
    while True:
        state = _add(at + 8 * _STATE, 0)
        begin, rows, chunk = state & _ALL_TAKEN, words[_ROWS], words[_CHUNK]
        results, operands = words[_RESULTS], words[_OPERANDS]
        if begin >= rows:
            return
        if _exchange(at + 8 * _STATE, state, state + chunk) == state:
            end = min(begin + chunk, rows)
            work(results, operands, begin, end)
            _add(at + 8 * _DONE, end - begin)


@no_type_check
def _serve(at):
    call, words = np.zeros(1, np.int64), carray(addresses_at(at), (_WORDS,))
    while True:
        if _read(types.int32(words[_READ]), call.ctypes.data, 8) == 8:
            take(at)


@no_type_check
def _answer(results, operands, _, _length, _status):
    sizes, at, call = _ints_at(addresses_at(operands)[0]), job(), np.ones(1, np.int64)
    rows, threads = sizes[0], sizes[1]
    # Another call may be under way, on another device of this process.
    if threads < 2 or _exchange(at + 8 * _BUSY, 0, 1) != 0:
        work(results, operands, 0, rows)
        return
    words = carray(addresses_at(at), (_WORDS,))
    # A thread that comes late to the job before finds it taken, and no other until this one is written down.
    state = words[_STATE]
    _add(at + 8 * _STATE, ((state >> _ROW_BITS) + 1 << _ROW_BITS) + _ALL_TAKEN - state)
    words[_RESULTS], words[_OPERANDS], words[_ROWS], words[_CHUNK] = results, operands, rows, sizes[2]
    words[_DONE] = 0
    _add(at + 8 * _STATE, -_ALL_TAKEN)
    for _ in range(1, threads):
        _write(types.int32(words[_WRITE]), call.ctypes.data, 8)
    take(at)
    # Those that others have begun; none waits for a thread that has not woken.
    while _add(at + 8 * _DONE, 0) < rows:
        _yield()
    _add(at + 8 * _BUSY, -1)


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

    symbol, words = f"{name}_job", np.zeros(_WORDS, np.int64)
    # A pipe wakes its reader on the core of the writer, which goes on working there.
    ends = (os.eventfd(0, os.EFD_SEMAPHORE),) * 2 if sys.platform == "linux" else os.pipe()
    words[_READ], words[_WRITE], words[_STATE] = *ends, _ALL_TAKEN
    binding.add_symbol(symbol, words.ctypes.data)
    take = njit(own(_take, work=work))
    serve = cfunc(types.void(types.intp), cache=cache)(own(_serve, take=take))
    for _ in range(helpers):
        threading.Thread(target=serve.ctypes, args=(words.ctypes.data,), daemon=True).start()
    answer = own(_answer, work=work, take=take, job=_address_of(symbol))
    return cfunc(_HANDLER, cache=cache)(answer), serve, words


def sizes_of(rows: int, threads: int, chunk: int, arguments: tuple[Any, ...]) -> np.ndarray:
    """Return the first operand of a call: its rows, threads and rows of a chunk, and the length of each argument."""
    return np.array([rows, max(1, threads), chunk, *(array.size for array in arguments)], np.int32)
