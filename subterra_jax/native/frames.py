"""XLA's custom calls without a C compiler: its structs by the names of their fields, and its threads put to work.

Source: `xla/ffi/api/c_api.h` of jaxlib 0.9 to 0.12, interface 0.2 to 0.5, on a machine with pointers of 8 bytes.
"""

from collections.abc import Callable
from types import FunctionType
from typing import Any, no_type_check

import numpy as np
from llvmlite import binding, ir
from numba import carray, cfunc, from_dtype, njit, types
from numba.core import cgutils
from numba.core.typing.templates import signature
from numba.extending import intrinsic

_WORD = ir.IntType(64)
_EXECUTE = 3  # XLA_FFI_ExecutionStage_EXECUTE


def _struct(**fields: Any) -> np.dtype:
    """Lay a struct out as C does; XLA's begin with their size and a list of extensions."""
    return np.dtype([("struct_size", "i8"), ("extension", "i8"), *fields.items()], align=True)


_VERSION = _struct(major="i4", minor="i4")
_LIST = _struct(size="i8", types="i8", items="i8")
_FRAME = _struct(api="i8", context="i8", stage="i4", args=_LIST, rets=_LIST)
_BUFFER = _struct(kind="i4", data="i8", rank="i8", dims="i8")
_METADATA_EXTENSION = _struct(following="i8", metadata="i8")
_METADATA = np.dtype([("struct_size", "i8"), ("version", _VERSION)])
_API = _struct(version=_VERSION, internal="i8", others=("i8", 11), schedule="i8", num_threads="i8")
_REQUEST = _struct(context="i8", first="i8", second="i8")  # arguments of the last two
# Rows not yet taken, rows done, threads that still use the job; the call and its rows; a request and its answer.
_JOB = np.dtype(
    [(name, "i8") for name in ("next", "done", "holders", "frame", "rows", "answer")] + [("request", _REQUEST)]
)
_NEXT, _DONE, _HOLDERS, _, _, _ANSWER, _ASKED = range(0, 56, 8)  # where these are in a job
_JOB_SIZE, _API_SIZE = _JOB.itemsize, _API.itemsize


def _at(kind: types.Type) -> Any:
    """Return a compiled function that takes an address for a record or a pointer."""

    @intrinsic
    def at(typing: Any, address: Any) -> Any:
        return signature(kind, types.intp), lambda context, builder, sig, args: builder.inttoptr(
            args[0], context.get_value_type(kind)
        )

    return at


_frame_at, _buffer_at, _extension_at, _metadata_at, _api_at, _job_at = (
    _at(from_dtype(struct)) for struct in (_FRAME, _BUFFER, _METADATA_EXTENSION, _METADATA, _API, _JOB)
)
_words_at, _floats_at = (_at(types.CPointer(kind)) for kind in (types.int64, types.float32))


@njit
@no_type_check
def _wants_work(frame):
    """Return whether XLA asks for results. If it asks for the handler's version instead, answer that: XLA's own."""
    call = _frame_at(frame)
    if call.extension == 0:
        return call.stage == _EXECUTE
    ours, theirs = _metadata_at(_extension_at(call.extension).metadata).version, _api_at(call.api).version
    ours.major = theirs.major
    ours.minor = theirs.minor
    return False


@njit
@no_type_check
def _flat(address):
    buffer, count = _buffer_at(address), 1
    for axis in range(buffer.rank):
        count *= _words_at(buffer.dims)[axis]
    return carray(_floats_at(buffer.data), (count,))


@njit
@no_type_check
def argument(frame, i):
    """Return the i-th argument as a flat array of float32; `.view` gives other numbers of 32 bits."""
    return _flat(_words_at(_frame_at(frame).args.items)[i])


@njit
@no_type_check
def result(frame, i):
    """Return the i-th result, as `argument`."""
    return _flat(_words_at(_frame_at(frame).rets.items)[i])


@njit
@no_type_check
def length(frame, i, axis):
    """Return the length of an axis of the i-th argument."""
    return _words_at(_buffer_at(_words_at(_frame_at(frame).args.items)[i]).dims)[axis]


_allocate = types.ExternalFunction("malloc", signature(types.intp, types.intp))
_release = types.ExternalFunction("free", signature(types.void, types.intp))
_yield_thread = types.ExternalFunction("sched_yield", signature(types.int32))


@intrinsic
def _fetch_add(typing: Any, address: Any, value: Any) -> Any:
    """Add to an 8-byte integer atomically; return its value before."""
    return signature(types.int64, types.intp, types.int64), lambda context, builder, sig, args: builder.atomic_rmw(
        "add", builder.inttoptr(args[0], _WORD.as_pointer()), args[1], "seq_cst"
    )


@intrinsic
def _call(typing: Any, function: Any, argument: Any) -> Any:
    """Call the C function at an address with one pointer; return the pointer that it returns."""
    kind = ir.FunctionType(_WORD, [_WORD])
    return signature(types.intp, types.intp, types.intp), lambda context, builder, sig, args: builder.call(
        builder.inttoptr(args[0], kind.as_pointer()), [args[1]]
    )


@njit
@no_type_check
def _ask(function, job, first, second):
    """Call a function of XLA's thread pool; return 0 on success."""
    asked = _job_at(job).request
    asked.struct_size = 40 if second else 32
    asked.extension = 0
    asked.context = _frame_at(_job_at(job).frame).context
    asked.first = first
    asked.second = second
    return _call(function, job + _ASKED)


@njit
@no_type_check
def _leave(job):
    if _fetch_add(job + _HOLDERS, -1) == 1:
        _release(job)


# Of each kernel: `handler_of` puts its own in their place.
work, chunk, take_chunks, helper = None, 1, None, None


@no_type_check
def _take_chunks(job):
    frame, rows = _job_at(job).frame, _job_at(job).rows
    begin = _fetch_add(job + _NEXT, chunk)
    while begin < rows:
        end = min(begin + chunk, rows)
        work(frame, begin, end)
        _fetch_add(job + _DONE, end - begin)
        begin = _fetch_add(job + _NEXT, chunk)


@no_type_check
def _help_once(job):
    take_chunks(job)
    _leave(job)


@no_type_check
def _answer(frame):
    if not _wants_work(frame):
        return 0
    rows, api = length(frame, 0, 0), _api_at(_frame_at(frame).api)
    if rows < 2 * chunk or api.struct_size < _API_SIZE:
        work(frame, 0, rows)
        return 0
    job = _allocate(_JOB_SIZE)
    this = _job_at(job)
    this.frame, this.rows, this.next, this.done, this.answer = frame, rows, 0, 0, 1
    _ask(api.num_threads, job, job + _ANSWER, 0)
    helpers = min(this.answer, (rows + chunk - 1) // chunk) - 1
    this.holders = helpers + 1
    for _ in range(helpers):
        if _ask(api.schedule, job, helper(), job) != 0:
            _leave(job)
    take_chunks(job)
    while _fetch_add(job + _DONE, 0) < rows:
        _yield_thread()
    _leave(job)
    return 0


def _address_of(symbol: str) -> Any:
    """Return a compiled function that gives the address of a C function."""

    @intrinsic
    def address(typing: Any) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            kind = ir.FunctionType(ir.VoidType(), [_WORD])
            return builder.ptrtoint(cgutils.get_or_insert_function(builder.module, kind, symbol), _WORD)

        return signature(types.intp), emit

    return address


def handler_of(work: Callable[..., None], chunk: int, name: str, cache: bool) -> tuple[Any, Any]:
    """Return a handler of XLA's that does the rows of a call on all threads of its pool, and its helper.

    The calling thread takes chunks of rows like every helper, and waits only for chunks that a helper has begun. A
    helper that starts late or never finds nothing left to do, so a busy pool cannot block the call.

    Args:
        work: Compiled function of a call's frame and the first row and the one after the last; the first axis of the
            first argument counts rows.
        chunk: Rows to take at a time; fewer than two chunks are not shared.
        name: Name of the kernel; must be unique.
        cache: Keep the machine code on disk.
    """

    def own(function: Callable[..., Any], **others: Any) -> Callable[..., Any]:
        # Numba numbers functions of one name anew in every process: code of two of them on disk would be mixed up. And
        # it takes a closure for another one in every process.
        made = FunctionType(function.__code__, {**globals(), "work": work, "chunk": chunk, **others})
        made.__name__ = made.__qualname__ = name + function.__name__
        return made

    shared, symbol = njit(own(_take_chunks)), f"{name}_helper"
    help_once = cfunc(types.void(types.intp), cache=cache)(own(_help_once, take_chunks=shared))
    binding.add_symbol(symbol, help_once.address)
    answer = own(_answer, take_chunks=shared, helper=_address_of(symbol))
    return cfunc(types.intp(types.intp), cache=cache)(answer), help_once
