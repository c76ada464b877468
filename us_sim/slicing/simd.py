"""Two machine operations that numba has no words for, as LLVM has them on every processor.

>>> import numpy as np
>>> from numba import njit
>>> from us_sim.slicing.simd import LANES, load_pair, write_ramp
>>> @njit
... def write(line):
...     write_ramp(line, np.uint64(1), np.int32(10), np.int32(3), np.int32(4))
>>> line = np.zeros(1 + LANES, dtype=np.int32)
>>> write(line)
>>> line[:6]
array([ 0, 10, 13, 16, 19,  0], dtype=int32)
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

__all__ = ["LANES", "load_pair", "write_ramp"]

LANES = 16
"""Numbers that `write_ramp` writes at once; beyond its last one an array has room for these."""


@intrinsic
def write_ramp(_: Any, array: Any, index: Any, start: Any, step: Any, count: Any) -> Any:
    """Writes start, start + step, … from ``array[index]`` on: ``count`` int32, at most `LANES`.

    A loop with so few rounds is not vectorised, or with a longer tail than body.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = ir.IntType(32)
        vector = ir.VectorType(number, LANES)
        array, index, start, step, count = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        lane = ir.Constant(vector, list(range(LANES)))
        ramp = builder.add(
            _broadcast(builder, start, vector),
            builder.mul(_broadcast(builder, step, vector), lane),
        )
        place = builder.bitcast(builder.gep(data, [index]), vector.as_pointer())
        before = builder.load(place)
        before.align = 1
        within = builder.icmp_signed("<", lane, _broadcast(builder, count, vector))
        builder.store(builder.select(within, ramp, before), place).align = 1
        return context.get_dummy_value()

    return types.void(array, index, types.int32, types.int32, types.int32), generate


@intrinsic
def load_pair(_: Any, array: Any, index: Any) -> Any:
    """``array[index] | array[index + 1] << 8`` of a uint8 array, as one unaligned load."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, index = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        place = builder.bitcast(builder.gep(data, [index]), ir.IntType(16).as_pointer())
        pair = builder.load(place)
        pair.align = 1
        return pair

    return types.uint16(array, index), generate


def _broadcast(builder: Any, value: Any, vector: Any) -> Any:
    """A vector of one and the same number."""
    empty = ir.Constant(vector, ir.Undefined)
    one = builder.insert_element(empty, value, ir.Constant(ir.IntType(32), 0))
    first = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(one, empty, first)
