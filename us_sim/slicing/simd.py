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
"""Numbers that `write_ramp` touches at once: an array has room for these beyond its last one."""

_NUMBER = ir.IntType(32)
_VECTOR = ir.VectorType(_NUMBER, LANES)


def _write_ramp(_: Any, array: Any, index: Any, start: Any, step: Any, count: Any) -> Any:
    """A ramp's signature and the instructions that write it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, index, *numbers = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        start, step, count = (_broadcast(builder, number) for number in numbers)
        lane = ir.Constant(_VECTOR, list(range(LANES)))
        ramp = builder.add(start, builder.mul(step, lane))
        place = builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())
        before = builder.load(place)
        before.align = 1
        within = builder.icmp_signed("<", lane, count)
        builder.store(builder.select(within, ramp, before), place).align = 1
        return context.get_dummy_value()

    # Whatever the types of these, they are converted.
    numbers = [types.int32 for _ in (start, step, count)]
    return types.void(array, index, *numbers), generate


def _load_pair(_: Any, array: Any, index: Any) -> Any:
    """A pair's signature and the instructions that load it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, index = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        place = builder.bitcast(builder.gep(data, [index]), ir.IntType(16).as_pointer())
        pair = builder.load(place)
        pair.align = 1
        return pair

    return types.uint16(array, index), generate


def _broadcast(builder: Any, number: Any) -> Any:
    """A vector of one and the same number."""
    empty = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(empty, number, ir.Constant(_NUMBER, 0))
    return builder.shuffle_vector(one, empty, ir.Constant(_VECTOR, [0] * LANES))


write_ramp: Any = intrinsic(_write_ramp)
"""``write_ramp(array, index, start, step, count)`` writes start, start + step, … to an int32 array.

It writes ``count`` numbers from ``array[index]`` on, at most `LANES` of them, without a loop: one
of so few rounds is not vectorised, or does most of them in its tail.
"""

load_pair: Any = intrinsic(_load_pair)
"""``load_pair(array, index)`` of a uint8 array: its number there, and the next one times 256.

One load, aligned or not.
"""
