"""Functions of libc and of the core for compiled code, and arrays over memory at a given address.

All arguments are integers, including addresses. numba can cache calls through symbols, but not
calls through ctypes pointers.
"""

from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj

_codes: Any = cgutils
_arrays: Any = arrayobj
_int, _word = types.int32, types.intp


def _function(name: str, result: Any, *arguments: Any) -> Any:
    return types.ExternalFunction(name, result(*arguments))


clock_gettime = _function("clock_gettime", _int, _int, _word)
epoll_wait = _function("epoll_wait", _int, _int, _word, _int, _int)
errno_location = _function("__errno_location", _word)
memcpy = _function("memcpy", _word, _word, _word, _word)
poll = _function("poll", _int, _word, _word, _int)
ppoll = _function("ppoll", _int, _word, _word, _word, _word)
recvmmsg = _function("recvmmsg", _int, _int, _word, types.uint32, _int, _word)
sendmmsg = _function("sendmmsg", _int, _int, _word, types.uint32, _int)
syscall = _function("syscall", types.int64, *[types.int64] * 7)

# Functions of the core, see native/noack.h.
link_decide = _function("noack_link_decide", types.none, _word, *[types.int64] * 3, _word)
link_leave = _function("noack_link_leave", types.int64, _word, *[types.int64] * 5)
link_renew = _function("noack_link_renew", types.none, _word, _word, types.int64)

ECONNREFUSED = 111
ENOMEM = 12
CLOCK_REALTIME = 0
CLOCK_MONOTONIC = 1
MSG_DONTWAIT = 0x40
POLLIN = 1
POLLOUT = 4


def _array_at(typing_context: Any, like: Any, address: Any, rows: Any, columns: Any) -> Any:
    """Return an array of the type of ``like`` (contiguous, one or two dimensions) at an address."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.return_type
        element = context.get_data_type(kind.dtype)
        item_bytes = context.get_constant(types.intp, context.get_abi_sizeof(element))
        shape, strides = [arguments[2]], [item_bytes]
        if kind.ndim == 2:
            shape.append(arguments[3])
            strides.insert(0, builder.mul(arguments[3], item_bytes))
        array = _arrays.make_array(kind)(context, builder)
        _arrays.populate_array(
            array,
            data=builder.inttoptr(arguments[1], element.as_pointer()),
            shape=_codes.pack_array(builder, shape),
            strides=_codes.pack_array(builder, strides),
            itemsize=item_bytes,
            meminfo=None,
        )
        return array._getvalue()

    return like(like, types.intp, types.intp, types.intp), generate


array_at: Any = intrinsic(_array_at)


def address_of(array: Any) -> Any:
    """Return the address of an array's first element, as a signed integer."""
    return np.int64(array.ctypes.data)


def errno(integers: Any) -> Any:
    """Return the errno of the last call; ``integers`` is any array of int32."""
    return array_at(integers, errno_location(), 1, 1)[0]


def clock_ns(clock: Any, time: Any) -> Any:
    """Read a clock; ``time`` is a buffer for a struct timespec, (2,) int64."""
    clock_gettime(clock, address_of(time))
    return time[0] * 1_000_000_000 + time[1]
