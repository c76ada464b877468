"""Two vector operations that numba lacks, in LLVM's instructions for every processor.

>>> import numpy as np
>>> from numba import njit
>>> from us_sim.slicing.cutting.simd import LANES, write_ramp
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

LANES = 16
"""Numbers that are read or written at once: arrays need room for as many beyond their last one."""

_NUMBER = ir.IntType(32)
_VECTOR = ir.VectorType(_NUMBER, LANES)
_PAIR = ir.IntType(16)
_PAIRS = ir.VectorType(_PAIR, LANES)
_INDEX = ir.IntType(64)


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

    # Indices and numbers of any type are converted.
    numbers = [types.int32 for _ in (start, step, count)]
    return types.void(array, index, *numbers), generate


def _load_pairs(
    _: Any, voxels: Any, near: Any, first: Any, to_y: Any, to_x: Any, p00: Any, p01: Any,
    p10: Any, p11: Any,
) -> Any:  # fmt: skip
    """The signature of the loads of four corners and their instructions."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def data(argument: int) -> Any:
            array = context.make_array(signature.args[argument])
            return array(context, builder, arguments[argument]).data

        _, _, first, to_y, to_x, *_ = arguments
        origin = data(0)
        corners = [
            builder.gep(origin, [step])
            for step in (ir.Constant(_INDEX, 0), to_y, to_x, builder.add(to_x, to_y))
        ]
        pairs = [ir.Constant(_PAIRS, ir.Undefined)] * 4
        places = builder.gep(data(1), [first])
        for lane in range(LANES):
            place = builder.load(builder.gep(places, [ir.Constant(_INDEX, lane)]))
            place = builder.zext(place, _INDEX)
            for k, corner in enumerate(corners):
                pair = builder.load(
                    builder.bitcast(builder.gep(corner, [place]), _PAIR.as_pointer())
                )
                pair.align = 1
                pairs[k] = builder.insert_element(pairs[k], pair, ir.Constant(_NUMBER, lane))
        for k, loaded in enumerate(pairs):
            place = builder.bitcast(builder.gep(data(5 + k), [first]), _PAIRS.as_pointer())
            builder.store(loaded, place).align = 1
        return context.get_dummy_value()

    index = types.uint64
    numbers = [index for _ in (first, to_y, to_x)]
    return types.void(voxels, near, *numbers, p00, p01, p10, p11), generate


def _broadcast(builder: Any, number: Any) -> Any:
    """A vector with the same number in every lane."""
    empty = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(empty, number, ir.Constant(_NUMBER, 0))
    return builder.shuffle_vector(one, empty, ir.Constant(_VECTOR, [0] * LANES))


write_ramp: Any = intrinsic(_write_ramp)
"""``write_ramp(array, index, start, step, count)`` writes start, start + step, … to an int32 array.

It writes ``count`` numbers from ``array[index]`` on, at most `LANES` of them, without a loop: one
of so few rounds is not vectorised, or does most of them in its tail.
"""

load_pairs: Any = intrinsic(_load_pairs)
"""``load_pairs(voxels, near, first, to_y, to_x, p00, p01, p10, p11)`` loads for `LANES` pixels.

From the voxel ``near[first]`` (uint32) of a uint8 array, the one ``to_y`` further, the one ``to_x``
further, and the one both further: each with the next one times 256, as one uint16. They are put
together in registers, since a store of each would take longer than its load.
"""
