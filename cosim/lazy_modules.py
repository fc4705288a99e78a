"""Modules that are loaded when one of their names is first used.

Commands and the library import at the top of their files, within :func:`lazy_modules`. So nothing
waits for what it does not use: help and completion of a command need none of its modules (up to
2 s of imports), `noack summary` no viewer, and `noack run` no analysis before its processes run.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from threading import RLock
from types import ModuleType
from typing import Any

_IS_LAZY = ContextVar("is_lazy", default=False)
"""Whether this thread imports lazily; not while it loads a module."""
_KNOWN = ("__class__", "__loader__", "__spec__")
"""Attributes that a module has before it is loaded, beside its submodules.

Imports read ``__spec__``, and CPython 3.11 discards an error that this raises, also Ctrl-C.
"""


class _LazyModule(ModuleType):
    def __getattribute__(self, name: str) -> Any:
        get = super().__getattribute__
        is_known = name in _KNOWN or isinstance(get("__dict__").get(name), ModuleType)
        # An import of a submodule that is not lazy reads __path__, and needs the package.
        if not is_known and not (name == "__path__" and _IS_LAZY.get()):
            loader = get("__loader__")
            assert isinstance(loader, _LazyLoader)
            loader.load(self)
        return get(name)


class _LazyLoader(Loader):
    """As :class:`importlib.util.LazyLoader`, which threads cannot share before Python 3.11.9."""

    def __init__(self, loader: Loader, package: str) -> None:
        self._loader, self._package = loader, package
        self._lock, self._loads = RLock(), False

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        module.__class__ = _LazyModule

    def load(self, module: ModuleType) -> None:
        """Load a module after its package, unless this thread is loading it.

        If another thread is, wait for its end.
        """
        token = _IS_LAZY.set(False)
        try:
            if self._package and not self._loads:
                load_module(self._package)
            with self._lock:
                if self._loads or module.__class__ is ModuleType:
                    return
                self._loads = True
                try:
                    self._loader.exec_module(module)
                    module.__class__ = ModuleType
                finally:
                    self._loads = False
        finally:
            _IS_LAZY.reset(token)


class _LazyFinder(MetaPathFinder):
    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        for finder in sys.meta_path if _IS_LAZY.get() else ():
            is_lazy = isinstance(finder, _LazyFinder)  # this one, or of a context around it
            spec = None if is_lazy else finder.find_spec(name, path, target)
            if spec is not None and spec.loader is not None:
                spec.loader = _LazyLoader(spec.loader, name.rpartition(".")[0])
                return spec
        return None


class _LoadedFinder(MetaPathFinder):
    """Finds a module that its own package has loaded since the import of it began.

    An import that is not lazy looks for the module, then reads ``__path__`` of its package. If that
    loads the package, which imports the module, the module must not be loaded a second time.
    """

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        module = sys.modules.get(name)
        return None if target is not None or module is None else ModuleSpec(name, _LoadedLoader(module))


class _LoadedLoader(Loader):
    def __init__(self, module: ModuleType) -> None:
        self._module, self._spec = module, module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self._module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec


sys.meta_path.insert(0, _LoadedFinder())


def load_module(name: str) -> ModuleType:
    """Import a module, and load it if it has been imported lazily."""
    module = import_module(name)
    vars(module)
    return module


@contextmanager
def lazy_modules() -> Iterator[None]:
    """Load the modules that are imported in this context when one of their names is used.

    For ``from package import module``, which loads the package; ``import package.module as module``
    does not.
    """
    finder, token = _LazyFinder(), _IS_LAZY.set(True)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        _IS_LAZY.reset(token)
