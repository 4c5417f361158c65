"""XLA's custom calls without a C compiler: its structs read by address, and its threads put to work.

Source: `xla/ffi/api/c_api.h` of jaxlib 0.9 to 0.12, interface 0.2 to 0.5. Offsets are those of a machine with pointers
of 8 bytes.

The calling thread takes chunks of rows like every helper, and waits only for chunks that a helper has begun. A helper
that starts late or never finds nothing left to do, so a busy pool cannot block the call.
"""

import ctypes
from collections.abc import Callable
from typing import Any, no_type_check

from llvmlite import ir
from numba import carray, njit, types
from numba.core.typing.templates import signature
from numba.extending import intrinsic

from subterra_jax.native import FFI_FIRST_MINOR, FFI_LAST_MINOR, FFI_MAJOR

# XLA_FFI_CallFrame: extension_start, api, ctx, stage, args.args, rets.rets; XLA_FFI_Buffer: data, rank, dims.
_API, _CONTEXT = 16, 24
_EXTENSION, _STAGE, _ARGS, _RESULTS = 8, 32, 72, 112
_DATA, _RANK, _DIMS = 24, 32, 40
# XLA_FFI_Metadata_Extension: metadata; XLA_FFI_Metadata and XLA_FFI_Api: api_version.major_version, .minor_version.
_METADATA, _META_MAJOR, _META_MINOR, _API_MAJOR, _API_MINOR = 24, 24, 28, 32, 36
_EXECUTE = 3


def _pointer(builder: ir.IRBuilder, address: ir.Value, element: ir.Type) -> ir.Value:
    return builder.inttoptr(address, element.as_pointer())


@intrinsic
def read64(typing: Any, address: Any) -> Any:
    """Read the 8-byte integer, or pointer, at an address."""
    return signature(types.int64, types.intp), lambda context, builder, sig, args: builder.load(
        _pointer(builder, args[0], ir.IntType(64))
    )


@intrinsic
def read32(typing: Any, address: Any) -> Any:
    """Read the 4-byte integer at an address."""
    return signature(types.int32, types.intp), lambda context, builder, sig, args: builder.load(
        _pointer(builder, args[0], ir.IntType(32))
    )


def _writer(kind: Any) -> Any:
    """Return a compiled function that writes an integer to an address."""

    @intrinsic
    def write(typing: Any, address: Any, value: Any) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            builder.store(args[1], _pointer(builder, args[0], ir.IntType(kind.bitwidth)))
            return context.get_dummy_value()

        return signature(types.void, types.intp, kind), emit

    return write


write32, write64 = _writer(types.int32), _writer(types.int64)


@intrinsic
def _floats_at(typing: Any, address: Any) -> Any:
    return signature(types.CPointer(types.float32), types.intp), lambda context, builder, sig, args: _pointer(
        builder, args[0], ir.FloatType()
    )


@intrinsic
def _ints_at(typing: Any, address: Any) -> Any:
    return signature(types.CPointer(types.int32), types.intp), lambda context, builder, sig, args: _pointer(
        builder, args[0], ir.IntType(32)
    )


@njit
@no_type_check
def wants_work(frame):
    """Return whether XLA asks for results. If it asks for the handler's version instead, answer that.

    The answer is XLA's own version if the structs are known to lie in memory as read here, else the nearest that is:
    XLA then refuses the handler unless it supports that version.
    """
    extension = read64(frame + _EXTENSION)
    if extension != 0:
        metadata, api = read64(extension + _METADATA), read64(frame + _API)
        minor = read32(api + _API_MINOR) if read32(api + _API_MAJOR) == FFI_MAJOR else FFI_LAST_MINOR
        write32(metadata + _META_MAJOR, FFI_MAJOR)
        write32(metadata + _META_MINOR, min(max(minor, FFI_FIRST_MINOR), FFI_LAST_MINOR))
        return False
    return read32(frame + _STAGE) == _EXECUTE


@njit
@no_type_check
def argument(frame, i):
    """Return the address of the i-th argument's buffer."""
    return read64(read64(frame + _ARGS) + 8 * i)


@njit
@no_type_check
def result(frame, i):
    """Return the address of the i-th result's buffer."""
    return read64(read64(frame + _RESULTS) + 8 * i)


@njit
@no_type_check
def size(buffer, axis):
    """Return the length of an axis of a buffer."""
    return read64(read64(buffer + _DIMS) + 8 * axis)


@njit
@no_type_check
def _count(buffer):
    count = 1
    for axis in range(read64(buffer + _RANK)):
        count *= size(buffer, axis)
    return count


@njit
@no_type_check
def floats(buffer):
    """Return a float32 buffer as a flat array."""
    return carray(_floats_at(read64(buffer + _DATA)), (_count(buffer),))


@njit
@no_type_check
def ints(buffer):
    """Return an int32 buffer as a flat array."""
    return carray(_ints_at(read64(buffer + _DATA)), (_count(buffer),))


def capsule(address: int) -> Any:
    """Wrap a function's address for `jax.ffi.register_ffi_target`."""
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    return new(address, None, None)


# XLA_FFI_Api: struct_size, XLA_FFI_ThreadPool_Schedule, XLA_FFI_ThreadPool_NumThreads.
_API_SIZE, _SCHEDULE, _NUM_THREADS, _KNOWN_API_SIZE = 0, 136, 144, 152
# A job: the call frame, first row not yet taken, rows, rows done, threads that still use the job, arguments of the two
# functions above and their answer.
_FRAME, _NEXT, _ROWS, _DONE, _HOLDERS, _REQUEST, _ANSWER, _JOB_SIZE = 0, 8, 16, 24, 32, 40, 80, 88

_allocate = types.ExternalFunction("malloc", signature(types.intp, types.intp))
_release = types.ExternalFunction("free", signature(types.void, types.intp))
_yield_thread = types.ExternalFunction("sched_yield", signature(types.int32))


@intrinsic
def _fetch_add(typing: Any, address: Any, value: Any) -> Any:
    """Add to an 8-byte integer atomically; return its value before."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        pointer = builder.inttoptr(args[0], ir.IntType(64).as_pointer())
        return builder.atomic_rmw("add", pointer, args[1], "seq_cst")

    return signature(types.int64, types.intp, types.int64), emit


@intrinsic
def _call_at(typing: Any, address: Any, argument: Any) -> Any:
    """Call the C function at an address with one pointer; return the pointer that it returns."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        word = ir.IntType(64)
        return builder.call(builder.inttoptr(args[0], ir.FunctionType(word, [word]).as_pointer()), [args[1]])

    return signature(types.intp, types.intp, types.intp), emit


def _compile_as(name: str) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function under a name of its own.

    Numba numbers the functions of one name anew in every process. Code that two processes have put on disk is linked
    by these names, so that a third process would take one function for another of the same name and number.
    """

    def compile_named(function: Callable[..., Any]) -> Any:
        function.__name__ = f"{name}_{function.__name__}"
        function.__qualname__ = f"{function.__qualname__}.{name}"
        return njit(function)

    return compile_named


def _as_c_function(function: Callable[..., Any], name: str) -> Any:
    """Make a compiled function of one integer a C function of one pointer; return a function that gives its address."""

    def forward(job: Any) -> None:
        function(job)

    forward.__qualname__ = f"{forward.__qualname__}.{name}"

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
    """Call one of the two functions of XLA's thread pool; return 0 on success."""
    request = job + _REQUEST
    write64(request, size)
    write64(request + 8, 0)
    write64(request + 16, read64(frame + _CONTEXT))
    write64(request + 24, third)
    write64(request + 32, fourth)
    return _call_at(read64(read64(frame + _API) + function), request)


def run_on_all_threads(work: Callable[..., None], chunk: int, name: str) -> Any:
    """Make `work(frame, begin, end)` into `run(frame, rows)`, which does all rows on all threads of XLA's pool.

    Args:
        work: Compiled function that does some rows of a call.
        chunk: Rows to take at a time; fewer than two chunks are not shared.
        name: Name of the helpers' code; must be unique.
    """

    @_compile_as(name)
    @no_type_check
    def take_chunks(job):
        frame, rows = read64(job + _FRAME), read64(job + _ROWS)
        while True:
            begin = _fetch_add(job + _NEXT, chunk)
            if begin >= rows:
                return
            end = min(begin + chunk, rows)
            work(frame, begin, end)
            _fetch_add(job + _DONE, end - begin)

    @_compile_as(name)
    @no_type_check
    def leave(job):
        if _fetch_add(job + _HOLDERS, -1) == 1:
            _release(job)

    @_compile_as(name)
    @no_type_check
    def help_once(job):
        take_chunks(job)
        leave(job)

    helper = _as_c_function(help_once, name)

    @_compile_as(name)
    @no_type_check
    def run(frame, rows):
        api = read64(frame + _API)
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
        take_chunks(job)
        while _fetch_add(job + _DONE, 0) < rows:
            _yield_thread()
        leave(job)

    return run
