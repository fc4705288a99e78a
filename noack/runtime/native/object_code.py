"""Compiled functions as object code, which loads without the compiler: it takes 0.3 s less.

A function takes arrays, records and (named) tuples of them, then one integer; it returns an
integer. Its code is kept as an object file for this kind of processor, which llvmlite links.
"""

import ctypes
import hashlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from noack.core.code_cache import CALLED_BY_CODE, compiling_alone
from noack.core.core_library import LIBRARY
from noack.core.file_access import write_whole


def code_file(folder: Path, name: str) -> Path:
    """Return the object file of a function in a cache folder, for this kind of processor."""
    import llvmlite.binding as llvm

    features = llvm.get_host_cpu_features().flatten()
    kind = f"{llvm.llvm_version_info} {llvm.get_host_cpu_name()} {features}".encode()
    digest = hashlib.blake2b(kind, digest_size=8).hexdigest()
    return folder / f"{name}-{digest}.object"


class NativeFunction:
    """A compiled function, called without the interpreter lock.

    Args:
        code: its object code, from :func:`compile_native`.

    Raises:
        ValueError: this is no such code.
    """

    def __init__(self, code: bytes) -> None:
        import llvmlite.binding as llvm

        head, _, objects = code.partition(b"\n")
        if head[: len(_sum(objects))] != _sum(objects):  # LLVM ends the process at damaged code
            raise ValueError("not the object code of a function")
        load_core()
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(objects))
        self._engine.finalize_object()
        address = self._engine.get_function_address(head[len(_sum(objects)) :].decode())
        kind = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)
        self._function = kind(address)
        self._result, self._error = ctypes.c_int64(), ctypes.c_void_p()
        self._result_at, self._error_at = map(ctypes.addressof, (self._result, self._error))
        self._tables: tuple[Any, ...] = ()
        self._words = np.zeros(1, np.int64)

    def __call__(self, *arguments: Any) -> int:
        """Call the function; tables that are the same objects as before are not examined again."""
        *tables, number = arguments
        if len(tables) != len(self._tables) or any(
            one is not other for one, other in zip(tables, self._tables, strict=True)
        ):
            self._tables = tuple(tables)
            self._words = np.array([*words_of(self._tables), 0], np.int64)
            self._words_at = self._words.ctypes.data
        self._words[-1] = number
        if self._function(self._result_at, self._error_at, self._words_at) != 0:
            raise RuntimeError("compiled code raised an exception")
        return self._result.value


def words_of(argument: Any) -> Iterator[int]:
    """Yield an argument as numbers: of an array its address and shape, of a record its address."""
    if isinstance(argument, tuple):
        for one in argument:
            yield from words_of(one)
    elif isinstance(argument, np.ndarray):
        if not argument.flags.c_contiguous:
            raise ValueError("compiled code takes contiguous arrays")
        yield argument.ctypes.data
        yield from argument.shape
    elif isinstance(argument, np.void):
        yield np.asarray(argument).ctypes.data  # shares its memory
    else:
        yield int(argument)


def load_core() -> None:
    """Let compiled code find the core's functions."""
    import llvmlite.binding as llvm

    llvm.load_library_permanently(str(LIBRARY))


def load_or_compile(
    file: Path | None, function: Callable[..., Any], arguments: Callable[[], tuple[Any, ...]]
) -> NativeFunction:
    """Return a function from its object file; if there is none, compile it first.

    Args:
        file: the object file; None: nowhere.
        function: the function; numba must know the functions that it calls.
        arguments: returns arguments of the types that it will be called with.
    """
    if file is None:
        return NativeFunction(compile_native(function, arguments()))
    if (kept := load(file)) is not None:
        return kept
    with compiling_alone(file.parent / ".lock"):
        if (kept := load(file)) is not None:
            return kept
        code = compile_native(function, arguments())
        with suppress(OSError):
            write_whole(file, code, make_folder=False)
    return NativeFunction(code)


def load(file: Path) -> NativeFunction | None:
    """Return the function in an object file; None if there is no such file, or nothing in it."""
    with suppress(OSError, ValueError):
        return NativeFunction(file.read_bytes())
    return None


def compile_native(function: Callable[..., Any], arguments: tuple[Any, ...]) -> bytes:
    """Compile a function for these types of arguments; return its object code."""
    import numba
    from numba.core import compiler
    from numba.core.registry import cpu_target
    from numba.extending import register_jitable

    compiling: Any = compiler
    kinds: Any = numba.typeof(arguments)  # type: ignore[no-untyped-call]
    call = register_jitable(**CALLED_BY_CODE, _nrt=False, forceinline=True)(function)
    unpack = _unpacker(kinds)

    def entry(words: int) -> Any:
        return np.int64(call(*unpack(words)))

    flags = compiling.Flags()
    flags.nrt = False
    flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
    compiled = compiling.compile_extra(
        cpu_target.typing_context, cpu_target.target_context, entry, (numba.intp,), numba.int64,
        flags, {},
    )  # fmt: skip
    name = compiled.fndesc.llvm_func_name
    compiled.library.get_pointer_to_function(name)
    objects: Any = compiled.library._get_compiled_object()
    return _sum(objects) + bytes(name.encode()) + b"\n" + bytes(objects)


def _sum(objects: bytes) -> bytes:
    """Return a check sum of object code."""
    return hashlib.blake2b(objects, digest_size=16).hexdigest().encode() + b" "


def _unpacker(kinds: Any) -> Any:
    """Return a compiled function that makes a tuple of :func:`words_of` at an address."""
    from llvmlite import ir
    from numba import types
    from numba.extending import intrinsic
    from numba.np import arrayobj

    arrays: Any = arrayobj
    tuple_type: Any = types.BaseTuple
    word = ir.IntType(64)

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        words, place = builder.inttoptr(arguments[0], word.as_pointer()), 0

        def take() -> Any:
            nonlocal place
            place += 1
            return builder.load(builder.gep(words, [ir.Constant(word, place - 1)]))

        def view(kind: Any) -> Any:
            data, shape = take(), [take() for _ in range(kind.ndim)]
            element = context.get_data_type(kind.dtype)
            size = item_bytes = ir.Constant(word, context.get_abi_sizeof(element))
            strides: list[Any] = []
            for length in reversed(shape):
                strides.insert(0, size)
                size = builder.mul(size, length)
            array = arrays.make_array(kind)(context, builder)
            arrays.populate_array(
                array, data=builder.inttoptr(data, element.as_pointer()), shape=shape,
                strides=strides, itemsize=item_bytes, meminfo=None,
            )  # fmt: skip
            return array._getvalue()

        def make(kind: Any) -> Any:
            if isinstance(kind, tuple_type):
                return context.make_tuple(builder, kind, [make(one) for one in kind.types])
            if isinstance(kind, types.Array):
                return view(kind)
            if isinstance(kind, types.Record):
                return builder.inttoptr(take(), context.get_value_type(kind))
            return context.cast(builder, take(), types.int64, kind)

        return make(kinds)

    def unpack(_: Any, words: Any) -> Any:
        return kinds(types.intp), generate

    return intrinsic(unpack)
