# mypy: allow-untyped-defs, allow-incomplete-defs
"""Calling a C function from compiled code, by an address known at run time.

An address passed as a value, not as a global, lets numba cache what calls it.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


@intrinsic
def call(typingctx: Any, address: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Call ``void f(void *, void *, void *, void *)``; address and arguments are int64."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        i64 = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [i64] * 4)
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), list(args[1:]))
        return context.get_dummy_value()

    return types.void(*[types.int64] * 5), codegen
