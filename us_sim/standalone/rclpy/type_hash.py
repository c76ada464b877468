"""The hash that says whether two sides mean the same by a type name.

>>> str(TypeHash(1, bytes(32)))[:12]
'RIHS01_00000'
"""

__all__ = ["TypeHash"]


class TypeHash:
    """Version and 32 bytes of a type hash (REP 2011); version -1 when it is not known."""

    __slots__ = ("_value", "_version")

    def __init__(self, version: int = -1, value: bytes = bytes(32)):
        self.version = version
        self.value = value

    @property
    def version(self) -> int:
        return self._version

    @version.setter
    def version(self, value: int) -> None:
        assert isinstance(value, int)
        self._version = value

    @property
    def value(self) -> bytes:
        return self._value

    @value.setter
    def value(self, value: bytes) -> None:
        assert isinstance(value, bytes)
        self._value = value

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TypeHash):
            return False
        return (self._version, self._value) == (other._version, other._value)

    __hash__ = None  # type: ignore[assignment]

    def __str__(self) -> str:
        if self._version <= 0 or len(self._value) != 32:
            return "INVALID"
        return f"RIHS{self._version:02}_{self._value.hex()}"
