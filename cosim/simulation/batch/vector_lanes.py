"""Vectors of n numbers in CPU registers, for compiled code.

A vector's length is part of its type. So a matrix-vector product compiles to straight-line code
without loops, memory access or reference counts. If a length cannot be taken from another vector,
it is passed as a tuple of that length (:func:`width`); the tuple's entries are not used.

Every product is added with fused rounding: x·y + z is rounded once. So results are bit-identical on
every machine with IEEE 754 arithmetic.
"""

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, models, overload, register_model

Width = tuple[int, ...]
"""A tuple of n entries with arbitrary values."""
Lanes = Any
"""A vector, in compiled code."""

_DOUBLE = ir.DoubleType()


def _built_in(build: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function for compiled code that emits its own LLVM instructions."""
    return intrinsic(build)


def width(n: int) -> Width:
    """Return the tuple that sets the vector length ``n`` in compiled code."""
    return (0,) * n


class LanesType(types.Type):
    """The compiler's type of a vector of ``n`` numbers."""

    def __init__(self, n: int) -> None:
        self.n = n
        super().__init__(name=f"Lanes({n})")


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, lanes: LanesType) -> None:
        super().__init__(manager, lanes, ir.VectorType(_DOUBLE, lanes.n))  # type: ignore[no-untyped-call]


def _is_width(number: Any) -> bool:
    return isinstance(number, types.UniTuple)


def _at(builder: Any, array: Any, array_type: Any, context: Any, place: Any, n: int) -> Any:
    """Return the pointer to n numbers of a contiguous array."""
    from numba.np.arrayobj import make_array

    data = make_array(array_type)(context, builder, array).data  # type: ignore[no-untyped-call]
    pointer = builder.gep(data, [place])
    return builder.bitcast(pointer, ir.VectorType(_DOUBLE, n).as_pointer())


def _splat(builder: Any, number: Any, n: int) -> Any:
    kind = ir.VectorType(_DOUBLE, n)
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), n), [0] * n)
    undefined = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(undefined, number, ir.IntType(32)(0))
    return builder.shuffle_vector(one, undefined, zeros)


def _fused(builder: Any, kind: Any, a: Any, b: Any, c: Any) -> Any:
    suffix = f"v{kind.count}f64" if isinstance(kind, ir.VectorType) else "f64"
    function = builder.module.globals.get(f"llvm.fma.{suffix}") or ir.Function(
        builder.module, ir.FunctionType(kind, [kind] * 3), f"llvm.fma.{suffix}"
    )
    return builder.call(function, [a, b, c])


@_built_in
def load(typing: Any, array: Any, place: Any, n: Any) -> Any:
    """Load a vector from an array, from index ``place`` on."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _at(builder, arguments[0], array, context, arguments[1], n.count)
        return builder.load(pointer, align=8)

    if _is_width(n):
        return LanesType(n.count)(array, types.intp, n), build
    return None


@_built_in
def store(typing: Any, array: Any, place: Any, v: Any) -> Any:
    """Store a vector in an array, from index ``place`` on."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _at(builder, arguments[0], array, context, arguments[1], v.n)
        builder.store(arguments[2], pointer, align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, v), build


@_built_in
def filled(typing: Any, number: Any, n: Any) -> Any:
    """Return a vector of equal numbers."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _splat(builder, arguments[0], n.count)

    return LanesType(n.count)(types.float64, n), build


@_built_in
def fma(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a·b + c, rounded once; b is a number or a vector."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        first, second, third = arguments
        if not isinstance(b, LanesType):
            second = _splat(builder, second, a.n)
        return _fused(builder, ir.VectorType(_DOUBLE, a.n), first, second, third)

    return a(a, b if isinstance(b, LanesType) else types.float64, c), build


@_built_in
def magnitude(typing: Any, v: Any) -> Any:
    """Return the absolute values."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind, name = ir.VectorType(_DOUBLE, v.n), f"llvm.fabs.v{v.n}f64"
        function = builder.module.globals.get(name) or ir.Function(
            builder.module, ir.FunctionType(kind, [kind]), name
        )
        return builder.call(function, arguments)

    return v(v), build


@_built_in
def times(typing: Any, array: Any, place: Any, v: Any, rows: Any) -> Any:
    """Return matrix times vector; the matrix is column-major in ``array`` from ``place`` on."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.VectorType(_DOUBLE, rows.count)
        total = None
        for j in range(v.n):
            place = builder.add(arguments[1], ir.IntType(64)(j * rows.count))
            pointer = _at(builder, arguments[0], array, context, place, rows.count)
            column = builder.load(pointer, align=8)
            number = builder.extract_element(arguments[2], ir.IntType(32)(j))
            factor = _splat(builder, number, rows.count)
            if total is None:
                total = builder.fmul(column, factor)
            else:
                total = _fused(builder, kind, column, factor, total)
        return total

    return LanesType(rows.count)(array, types.intp, v, rows), build


@_built_in
def dot(typing: Any, v: Any, w: Any) -> Any:
    """Inner product; its terms are added in pairs."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        products = builder.fmul(*arguments)
        terms = [builder.extract_element(products, ir.IntType(32)(i)) for i in range(v.n)]
        while len(terms) > 1:
            half = len(terms) // 2
            sums = [builder.fadd(terms[i], terms[i + half]) for i in range(half)]
            terms = sums + terms[2 * half :]
        return terms[0]

    return types.float64(v, w), build


def _elementwise(name: str) -> Any:
    @_built_in
    def elementwise(typing: Any, v: Any, w: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            first, second = arguments
            if not isinstance(w, LanesType):
                second = _splat(builder, second, v.n)
            return getattr(builder, name)(first, second)

        return v(v, w if isinstance(w, LanesType) else types.float64), build

    return elementwise


_PLAIN = {
    operator.add: _elementwise("fadd"),
    operator.sub: _elementwise("fsub"),
    operator.mul: _elementwise("fmul"),
}


def _overload(sign: Any, elementwise: Any) -> None:
    options: Any = {"_nrt": False, "forceinline": True}

    def applied(v: Any, w: Any) -> Any:
        return elementwise(v, w)

    @overload(sign, jit_options=options)
    def choose(v: Any, w: Any) -> Any:
        return applied if isinstance(v, LanesType) else None


for _sign, _applied in _PLAIN.items():
    _overload(_sign, _applied)
