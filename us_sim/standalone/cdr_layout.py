"""Python source that moves through CDR, and what it knows of its position.

The format is the OMG's CDR (CORBA 3.3, part 2, 9.3): every primitive is aligned to its own size,
counted from the end of the four-byte header. Here the padding is computed when the source is
generated wherever the position is known well enough, and at run time elsewhere.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np

from .field_setters import ARRAY_TYPES
from .interfaces import Field, interface

# Primitive: its character in a `struct` format.
FORMATS = {"bool": "?", "byte": "c", **{kind: code for kind, (code, _) in ARRAY_TYPES.items()}}
_PADS = tuple(bytes(n) for n in range(8))


class CdrLayout(ABC):
    """A function's source as it grows, and what is known of the position at its current end.

    ``known`` is (modulus, remainder): the distance from the header's end is ``remainder`` modulo
    the power of two ``modulus``, at most 8. Nothing is known modulo 1.
    """

    def __init__(self, order: str) -> None:
        self.lines: list[str] = []
        self.indent = 1
        self.order = order
        self.known = (8, 0)
        self.format, self.size = "", 0
        self.terms: list[str] = []
        self.variables = 0
        self.constants: list[Any] = []
        self.line("pos = 4")

    def compile(self, signature: str) -> Callable[..., Any]:
        namespace: dict[str, Any] = {"array": array, "np": np, "PADS": _PADS}
        namespace |= {f"c{index}": value for index, value in enumerate(self.constants)}
        exec("\n".join([f"def {signature}:", *self.lines]), namespace)
        return namespace[signature.split("(")[0]]

    def line(self, text: str) -> None:
        self.lines.append("    " * self.indent + text)

    def variable(self) -> str:
        self.variables += 1
        return f"v{self.variables}"

    def constant(self, value: Any) -> str:
        self.constants.append(value)
        return f"c{len(self.constants) - 1}"

    def advance(self, size: int) -> None:
        modulus, remainder = self.known
        self.known = (modulus, (remainder + size) % modulus)

    def fields(self, owner: str, type_name: str, placeholder: str) -> None:
        """All fields of a message; an empty one has a byte in their place."""
        definition = interface(type_name)
        for field in definition.fields:
            term = f"{owner}._{field.name}"
            if field.shape == "scalar":
                self.element(field, term)
            else:
                self.elements(field, term)
        if not definition.fields:
            self.primitive("B", placeholder)

    def primitive(self, code: str, term: str) -> None:
        """Append a primitive to the pending ``struct`` call."""
        size = struct.calcsize(f"={code}")
        modulus, remainder = self.known
        if size > modulus:
            self.align(size)
            remainder = 0
        pad = -remainder % size
        self.format += "x" * pad + code
        self.size += pad + size
        self.terms.append(term)
        self.advance(pad + size)

    def align(self, size: int) -> None:
        """Move to a multiple of ``size``, computing the padding at run time where it must be."""
        self.flush()
        modulus, remainder = self.known
        if size > modulus:
            self.pad(f"(4 - pos) & {size - 1}")
            self.known = (size, 0)
        elif pad := -remainder % size:
            self.pad(str(pad))
            self.advance(pad)

    def flush(self) -> None:
        """Emit the pending ``struct`` call."""
        if self.size:
            self.struct_call(struct.Struct(self.order + self.format))
            self.format, self.size, self.terms = "", 0, []

    def messages(self, header: str, field: Field, body: Callable[[], None]) -> None:
        """A loop over a list of messages or strings, laid out for what holds at every turn."""
        before = self.known
        size = _first_alignment(field)
        if field.shape == "array":
            self.align(size)
            before = self.known
        elif size > before[0] or before[1] % size:
            # Aligned once before the loop, the layout of every element is often known beforehand.
            self.when_not_empty(lambda: self.align(size))
        entry = self.known
        while True:
            mark = len(self.lines)
            self.known = entry
            self.line(header)
            self.indent += 1
            body()
            self.flush()
            self.indent -= 1
            met = _meet(entry, self.known)
            if met == entry:
                break
            del self.lines[mark:]
            entry = met
        self.known = _meet(before, self.known)

    def packed(self, size: int, emit: Callable[[], None]) -> None:
        """A sequence of ``n`` primitives of ``size`` bytes, aligned only if there are any."""
        before = self.known
        if size > before[0] or before[1] % size:
            self.when_not_empty(lambda: self.align(size))
        emit()
        self.known = _meet(before, (size, 0))

    def when_not_empty(self, emit: Callable[[], None]) -> None:
        self.line("if n:")
        self.indent += 1
        emit()
        self.indent -= 1

    @abstractmethod
    def pad(self, amount: str) -> None:
        """Emit ``amount`` (an expression) bytes of padding."""

    @abstractmethod
    def element(self, field: Field, term: str) -> None:
        """Emit what one value of a field's kind takes."""

    @abstractmethod
    def elements(self, field: Field, term: str) -> None:
        """Emit what an array or a sequence takes."""

    @abstractmethod
    def struct_call(self, packing: struct.Struct) -> None:
        """Emit the call of ``packing`` for the pending terms."""


def _first_alignment(field: Field) -> int:
    """The alignment of the first primitive of one element of ``field``."""
    if field.is_message:
        fields = interface(field.kind).fields
        if not fields:
            return 1
        return 4 if fields[0].shape == "sequence" else _first_alignment(fields[0])
    return 4 if field.kind == "string" else struct.calcsize(f"={FORMATS[field.kind]}")


def _meet(first: tuple[int, int], second: tuple[int, int]) -> tuple[int, int]:
    """What is known of a position of which one or the other is."""
    modulus = min(first[0], second[0])
    while (first[1] - second[1]) % modulus:
        modulus //= 2
    return modulus, first[1] % modulus
