"""Rows of a call shared out among the threads of XLA's own pool.

The calling thread takes chunks of rows like everybody else and waits only for chunks that somebody is busy with: a
helper that starts late, or never, finds nothing left to do. So nothing can lock, however busy the pool is.
"""

from collections.abc import Callable
from typing import Any, no_type_check

from llvmlite import ir
from numba import njit, types
from numba.core.typing.templates import signature
from numba.extending import intrinsic

from subterra_jax.native.frames import API, CONTEXT, read64, write64

# XLA_FFI_Api: struct_size, XLA_FFI_ThreadPool_Schedule, XLA_FFI_ThreadPool_NumThreads.
_API_SIZE, _SCHEDULE, _NUM_THREADS, _KNOWN_API_SIZE = 0, 136, 144, 152
# A job: the call frame, first row that nobody has taken, rows, rows done, threads that hold on to the job, arguments of
# the two functions above and their answer.
_FRAME, _NEXT, _ROWS, _DONE, _HOLDERS, _REQUEST, _ANSWER, _JOB_SIZE = 0, 8, 16, 24, 32, 40, 80, 88

_allocate = types.ExternalFunction("malloc", signature(types.intp, types.intp))
_release = types.ExternalFunction("free", signature(types.void, types.intp))
_let_others_run = types.ExternalFunction("sched_yield", signature(types.int32))


@intrinsic
def _fetch_add(typing: Any, address: Any, value: Any) -> Any:
    """Add to an 8-byte integer in one piece; what it was before."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        pointer = builder.inttoptr(args[0], ir.IntType(64).as_pointer())
        return builder.atomic_rmw("add", pointer, args[1], "seq_cst")

    return signature(types.int64, types.intp, types.int64), emit


@intrinsic
def _call_at(typing: Any, address: Any, argument: Any) -> Any:
    """Call the C function at an address with one pointer; its result, a pointer too."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        word = ir.IntType(64)
        return builder.call(builder.inttoptr(args[0], ir.FunctionType(word, [word]).as_pointer()), [args[1]])

    return signature(types.intp, types.intp, types.intp), emit


def _as_c_function(function: Callable[..., Any], name: str) -> Any:
    """Address, within compiled code, of a compiled function of one integer as a C function of one pointer."""

    def forward(job: Any) -> None:
        function(job)

    @intrinsic
    def address(typing: Any) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            word, inner = ir.IntType(64), signature(types.none, types.intp)
            entry = ir.Function(builder.module, ir.FunctionType(ir.VoidType(), [word]), name)
            entry.linkage = "internal"
            inside = ir.IRBuilder(entry.append_basic_block())
            body = context.compile_subroutine(inside, forward, inner)
            context.call_internal_no_propagate(inside, body.fndesc, inner, entry.args)
            inside.ret_void()
            return builder.ptrtoint(entry, word)

        return signature(types.intp), emit

    return address


@njit
@no_type_check
def _ask(frame, job, function, third, fourth, size):
    """Call one of the two functions of XLA's thread pool; 0 if it did as it was told."""
    request = job + _REQUEST
    write64(request, size)
    write64(request + 8, 0)
    write64(request + 16, read64(frame + CONTEXT))
    write64(request + 24, third)
    write64(request + 32, fourth)
    return _call_at(read64(read64(frame + API) + function), request)


def shared_out(work: Callable[..., None], chunk: int, name: str) -> Any:
    """`work(frame, begin, end)` made into `run(frame, rows)`, which does all rows, `chunk` at a time, on all threads.

    Args:
        work: Compiled function that does some rows of a call.
        chunk: Rows to take at a time; fewer than two chunks are not shared.
        name: Name of the helpers' code, unlike any other's.
    """

    @njit
    @no_type_check
    def take_part(job):
        frame, rows = read64(job + _FRAME), read64(job + _ROWS)
        while True:
            begin = _fetch_add(job + _NEXT, chunk)
            if begin >= rows:
                return
            end = min(begin + chunk, rows)
            work(frame, begin, end)
            _fetch_add(job + _DONE, end - begin)

    @njit
    @no_type_check
    def leave(job):
        if _fetch_add(job + _HOLDERS, -1) == 1:
            _release(job)

    @njit
    @no_type_check
    def help_out(job):
        take_part(job)
        leave(job)

    helper = _as_c_function(help_out, name)

    @njit
    @no_type_check
    def run(frame, rows):
        api = read64(frame + API)
        if rows < 2 * chunk or read64(api + _API_SIZE) < _KNOWN_API_SIZE:
            work(frame, 0, rows)
            return
        job = _allocate(_JOB_SIZE)
        write64(job + _FRAME, frame)
        write64(job + _NEXT, 0)
        write64(job + _ROWS, rows)
        write64(job + _DONE, 0)
        write64(job + _ANSWER, 1)
        _ask(frame, job, _NUM_THREADS, job + _ANSWER, 0, 32)
        helpers = min(read64(job + _ANSWER), (rows + chunk - 1) // chunk) - 1
        write64(job + _HOLDERS, helpers + 1)
        for _ in range(helpers):
            if _ask(frame, job, _SCHEDULE, helper(), job, 40) != 0:
                leave(job)
        take_part(job)
        while _fetch_add(job + _DONE, 0) < rows:
            _let_others_run()
        leave(job)

    return run
