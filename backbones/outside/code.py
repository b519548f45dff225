"""Code that a user names: `FILE.py:NAME` or `package.module:NAME`, imported, and known by its content."""

from __future__ import annotations

import difflib
import hashlib
import importlib
import importlib.util
import inspect
import re
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from semstab.errors import ConfigError, DataError, MissingDependencyError, one_line

T = TypeVar("T")

MODULE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


@dataclass(frozen=True)
class Code:
    """A class or a function in a user's file or package.

    text    as it was named
    name    of the class or the function
    target  itself
    module  where it is
    """

    text: str
    name: str
    target: Callable[..., Any]
    module: ModuleType

    @classmethod
    def load(cls, text: str) -> Code:
        """Import it. Raises ConfigError where it is not there, MissingDependencyError, DataError where it fails."""
        place, _, name = text.rpartition(":")
        if not place or not name.isidentifier():
            raise ConfigError(
                f"backbone '{text}': write FILE.py:NAME or package.module:NAME, NAME a class or a function"
            )
        module = guarded(text, lambda: _of_file(Path(place)) if place.endswith(".py") else _of_package(place, text))
        target = getattr(module, name, None)
        if target is None:
            own = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
            near = difflib.get_close_matches(name, own, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(own) or 'nothing to call'}"
            raise ConfigError(f"{place}: has no '{name}'; {hint}")
        if not callable(target):
            raise ConfigError(f"{text}: is a {type(target).__name__}; name a class, or a function of an image")
        return cls(text, name, target, module)

    @property
    def digest(self) -> str:
        """Of the file that it stands in."""
        file = self.module.__file__
        return "" if file is None else hashlib.blake2b(Path(file).read_bytes(), digest_size=16).hexdigest()

    def accepts(self, options: dict[str, Any], *more: Any) -> None:
        """Raises ConfigError where it cannot be called with `more` and these options."""
        try:
            inspect.signature(self.target).bind(*more, **options)
        except ValueError:  # compiled code does not say
            return
        except TypeError as error:
            raise ConfigError(
                f"{self.text}: {error}; options are KEY=VALUE after its name, or --set KEY=VALUE"
            ) from error


def is_code(name: str) -> bool:
    """Whether a backbone's name says where code is, and is none of a registry."""
    return ":" in name or name.endswith(".py")


def absolute(name: str) -> str:
    """The name of code, its file's from the root of the file system."""
    place, _, what = name.rpartition(":")
    return f"{Path(place).expanduser().absolute()}:{what}" if place.endswith(".py") else name


def guarded(text: str, do: Callable[[], T]) -> T:
    """What user's code does; what it raises becomes one line that says where it was raised."""
    try:
        return do()
    except (ConfigError, DataError, MissingDependencyError):
        raise
    except ImportError as error:
        package = f"; install {error.name.partition('.')[0]}" if error.name else ""
        raise MissingDependencyError(f"{text}: it imports what is not there ({one_line(error)}){package}") from error
    except (Exception, SystemExit) as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        at = f"{Path(last.filename).name}:{last.lineno}"
        if isinstance(error, SyntaxError):
            at = f"{Path(error.filename or '').name}:{error.lineno}"
        raise DataError(f"{text}: {type(error).__name__} at {at}: {one_line(error)}") from error


def _of_file(path: Path) -> ModuleType:
    path = path.expanduser()
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file")
    content = hashlib.blake2b(str(path.resolve()).encode() + path.read_bytes(), digest_size=6).hexdigest()
    name = f"{path.stem}_{content}"  # of its own, whatever else is called like the file, and of this version
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    _may_import_from(path.resolve().parent)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _of_package(place: str, text: str) -> ModuleType:
    if not MODULE.fullmatch(place):
        raise ConfigError(f"backbone '{text}': write FILE.py:NAME or package.module:NAME, NAME a class or a function")
    _may_import_from(Path.cwd())
    return importlib.import_module(place)


def _may_import_from(folder: Path) -> None:
    """Last, so that nothing there takes the place of an installed package."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
