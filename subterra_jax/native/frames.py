"""XLA's foreign-function frames, read by address: a numba function as a custom call, with no C compiler.

Source: `xla/ffi/api/c_api.h` of jaxlib, API 0.x, whose structs only ever grow at their ends. Offsets are those of a
machine with pointers of 8 bytes.
"""

import ctypes
from typing import Any, no_type_check

from llvmlite import ir
from numba import carray, njit, types
from numba.core.typing.templates import signature
from numba.extending import intrinsic

# XLA_FFI_CallFrame: extension_start, api, ctx, stage, args.args, rets.rets; XLA_FFI_Buffer: data, rank, dims.
API, CONTEXT = 16, 24
_EXTENSION, _STAGE, _ARGS, _RESULTS = 8, 32, 72, 112
_DATA, _RANK, _DIMS = 24, 32, 40
# XLA_FFI_Metadata_Extension: metadata; XLA_FFI_Metadata and XLA_FFI_Api: api_version.major_version, .minor_version.
_METADATA, _META_MAJOR, _META_MINOR, _API_MAJOR, _API_MINOR = 24, 24, 28, 32, 36
_EXECUTE = 3


def _pointer(builder: ir.IRBuilder, address: ir.Value, element: ir.Type) -> ir.Value:
    return builder.inttoptr(address, element.as_pointer())


@intrinsic
def read64(typing: Any, address: Any) -> Any:
    """The 8-byte integer, or pointer, at an address."""
    return signature(types.int64, types.intp), lambda context, builder, sig, args: builder.load(
        _pointer(builder, args[0], ir.IntType(64))
    )


@intrinsic
def read32(typing: Any, address: Any) -> Any:
    """The 4-byte integer at an address."""
    return signature(types.int32, types.intp), lambda context, builder, sig, args: builder.load(
        _pointer(builder, args[0], ir.IntType(32))
    )


def _writer(kind: Any) -> Any:
    """A compiled function that puts an integer at an address."""

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
    """Whether XLA asks for results; a question about the handler itself is answered on the way."""
    extension = read64(frame + _EXTENSION)
    if extension != 0:
        # XLA asks which version of the API the handler speaks: the structs read here are the same in all of 0.x.
        metadata, api = read64(extension + _METADATA), read64(frame + API)
        write32(metadata + _META_MAJOR, read32(api + _API_MAJOR))
        write32(metadata + _META_MINOR, read32(api + _API_MINOR))
        return False
    return read32(frame + _STAGE) == _EXECUTE


@njit
@no_type_check
def argument(frame, i):
    """Address of the i-th argument's buffer."""
    return read64(read64(frame + _ARGS) + 8 * i)


@njit
@no_type_check
def result(frame, i):
    """Address of the i-th result's buffer."""
    return read64(read64(frame + _RESULTS) + 8 * i)


@njit
@no_type_check
def size(buffer, axis):
    """Length of an axis of a buffer."""
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
    """A float32 buffer as a flat array."""
    return carray(_floats_at(read64(buffer + _DATA)), (_count(buffer),))


@njit
@no_type_check
def ints(buffer):
    """An int32 buffer as a flat array."""
    return carray(_ints_at(read64(buffer + _DATA)), (_count(buffer),))


def capsule(address: int) -> Any:
    """A function's address as `jax.ffi.register_ffi_target` takes it."""
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    return new(address, None, None)
