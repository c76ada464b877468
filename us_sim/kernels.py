"""Kernels: numba's `njit`, whose compiled code is kept where only its owner writes.

Compiled code is a pickle with machine code in it: one flipped bit of it ends a process, and whoever
may write it may do anything. So a file is used only if it belongs to this user (or to root), nobody
else may write it, and its checksum is right. Any other is compiled again, and a warning says so.
`NUMBA_CACHE_DIR` names another folder than `kernels` in that of `us_sim.cache`.

>>> from us_sim.kernels import njit
>>> @njit(nogil=True)  # and cache=True in a module; an example like this has no file
... def twice(x):
...     return 2 * x
>>> twice(21)
42
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

from us_sim.cache import cache_folder

_DIGEST = 32  # bytes of a checksum, at the beginning of a file
_WRITABLE_BY_OTHERS = 0o022

_logger = logging.getLogger(__name__)
_said: set[str] = set()


def njit(function: Callable[..., Any] | None = None, *, cache: bool = False, **options: Any) -> Any:
    """As ``numba.njit``; with ``cache`` the compiled code is kept, and checked before it is used.

    Args:
        function: the kernel, where the decorator stands without brackets.
        cache: keep it.
        options: of ``numba.njit``.
    """

    def decorate(kernel: Callable[..., Any]) -> Any:
        # A wrapper for C is a second copy of the kernel, and nothing here is called from C.
        dispatcher = numba.njit(**{**options, "no_cfunc_wrapper": True})(kernel)
        if cache and isinstance(dispatcher, Dispatcher):
            dispatcher._cache = _KernelCache(kernel)  # type: ignore[attr-defined]
        return dispatcher

    return decorate if function is None else decorate(function)


def kernel_folder() -> Path:
    """Where compiled code is kept: NUMBA_CACHE_DIR, or `kernels` in the cache folder."""
    given = getattr(config, "CACHE_DIR", "")
    return Path(given) if given else cache_folder() / "kernels"


# Its name differs between numba's versions.
_UserProvidedCacheLocator: Any = CompileResultCacheImpl._locator_classes[0]


class _Locator(_UserProvidedCacheLocator):
    """The folder of a source file's kernels, which is made when there is something to keep."""

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        self._py_file = py_file
        self._lineno = py_func.__code__.co_firstlineno
        self._cache_path = str(kernel_folder() / self.get_suitable_cache_subpath(py_file))

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _Locator | None:
        return cls(py_func, py_file) if os.path.isfile(py_file) else None

    def ensure_cache_path(self) -> None:
        """Do nothing: `save` makes the folder."""


class _Implementation(CompileResultCacheImpl):
    _locator_classes = [_Locator, *CompileResultCacheImpl._locator_classes]  # noqa: RUF012


class _KernelCache(FunctionCache):
    """Numba's cache of one kernel, with checked files under it."""

    _impl_class = _Implementation

    def __init__(self, py_func: Callable[..., Any]) -> None:
        super().__init__(py_func)
        self._cache_file: Any = _CheckedFiles(
            Path(self._cache_path), self._impl.filename_base, self._impl.locator.get_source_stamp()
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The code for these types of arguments; None where there is none that can be used."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # whole, but of something that is no longer there
            self._cache_file.refuse(error)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep it; where that cannot be, a warning says so."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _say_once(
                "kept", "%s cannot be written (%s): kernels are not kept", self._cache_path, error
            )


class _CheckedFiles:
    """The code of one kernel, a file for the types of its arguments: a checksum, and a pickle."""

    def __init__(self, folder: Path, name: str, source: object) -> None:
        self._folder = folder
        self._of_version = f"{name}.{numba.__version__}-"
        self._name = f"{self._of_version}{_short(repr(source))}."
        self._last = folder

    def load(self, key: object) -> Any:
        """The data kept under a key; None where there is none that can be used."""
        path = self._last = self._path(key)
        try:
            with path.open("rb") as file:
                state = os.fstat(file.fileno())
                content = file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            self.refuse(error)
            return None
        own = not hasattr(os, "geteuid") or state.st_uid in (0, os.geteuid())
        if not own or state.st_mode & _WRITABLE_BY_OTHERS:
            self.refuse("others may have written it")
        elif _checksum(path.name, content[_DIGEST:]) != content[:_DIGEST]:
            self.refuse("its checksum is wrong")
        else:
            return pickle.loads(content[_DIGEST:])
        return None

    def refuse(self, why: object) -> None:
        """Say that the file of the last key is not used, and let go of it."""
        _say_once("used", "%s is not used (%s), so its kernel is compiled again", self._last, why)
        with contextlib.suppress(OSError):
            self._last.unlink()

    def save(self, key: object, data: object) -> None:
        """Keep ``data``, and remove the data of earlier versions of the source file.

        Raises:
            OSError: it cannot be written.
        """
        path = self._path(key)
        content = dumps(data)
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        number, partial = tempfile.mkstemp(prefix=f"{path.name}.", dir=self._folder)
        try:
            with os.fdopen(number, "wb") as file:
                file.write(_checksum(path.name, content) + content)
            os.replace(partial, path)
        except OSError:
            with contextlib.suppress(OSError):
                os.unlink(partial)
            raise
        for other in self._folder.iterdir():
            if other.name.startswith(self._of_version) and not other.name.startswith(self._name):
                with contextlib.suppress(OSError):
                    other.unlink()

    def flush(self) -> None:
        """Forget all of this kernel."""
        for path in self._folder.glob("*"):
            if path.name.startswith(self._name):
                path.unlink()

    def _path(self, key: object) -> Path:
        return self._folder / f"{self._name}{_short(repr(key))}.kernel"


def _checksum(name: str, content: bytes) -> bytes:
    """Of a file under its own name, so that another kernel's file is none of this one."""
    return hashlib.blake2b(name.encode() + b"\0" + content, digest_size=_DIGEST).digest()


def _short(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=12).hexdigest()


def _say_once(kind: str, sentence: str, *words: object) -> None:
    """A warning the first time; many kernels are damaged by one cause."""
    _logger.log(logging.DEBUG if kind in _said else logging.WARNING, sentence, *words)
    _said.add(kind)


def warm_up() -> None:
    """Have numba made ready: the first kernel of a process takes far longer than the others."""
    _nothing()


@njit(cache=True)
def _nothing() -> None:
    """The kernel that does nothing."""
