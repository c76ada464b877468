"""A package under a second name: the same modules, imported when they are first asked for.

>>> import sys
>>> sys.meta_path.insert(0, AliasFinder("shapes", "collections"))
>>> import shapes.abc, collections.abc
>>> shapes.abc is collections.abc
True
"""

import importlib
import importlib.util
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


class AliasFinder(MetaPathFinder, Loader):
    """Imports `alias.x` as `target.x`."""

    def __init__(self, alias: str, target: str) -> None:
        self._alias = alias
        self._target = target
        self._true_specs: dict[str, ModuleSpec | None] = {}

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,  # noqa: ARG002
        target: ModuleType | None = None,  # noqa: ARG002
    ) -> ModuleSpec | None:
        if fullname != self._alias and not fullname.startswith(f"{self._alias}."):
            return None
        original = importlib.util.find_spec(self._original(fullname))
        if original is None:
            return None
        is_package = original.submodule_search_locations is not None
        return ModuleSpec(fullname, self, origin=original.origin, is_package=is_package)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(self._original(spec.name))
        self._true_specs[module.__name__] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        # The import system has just given the module the alias's spec; relative imports inside it
        # need its own.
        module.__spec__ = self._true_specs.pop(module.__name__)

    def _original(self, name: str) -> str:
        return self._target + name[len(self._alias) :]
