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
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from semstab.core.files import file_digest
from semstab.core.process import printing_aside
from semstab.errors import ConfigError, DataError, MissingDependencyError, summarize_error

T = TypeVar("T")

MODULE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


@dataclass(frozen=True)
class Code:
    """A class or a function in a user's file or package.

    Attributes:
        text: The name as it was given.
        name: Name of the class or the function.
        target: The class or the function itself.
        module: The module that holds it.
    """

    text: str
    name: str
    target: Callable[..., Any]
    module: ModuleType

    @classmethod
    def load(cls, text: str, kind: str) -> Code:
        """Import it, as a model or another kind of part.

        Raises:
            ConfigError: If it is not there, or a run folder names it and the user does not (`only_named`).
            MissingDependencyError, DataError: If it fails.
        """
        require_named(text)
        source, _, name = text.rpartition(":")
        in_file = source.endswith(".py")
        if not name.isidentifier() or not (in_file or MODULE.fullmatch(source)):
            raise ConfigError(f"{kind} '{text}': write FILE.py:NAME or package.module:NAME, NAME a class or a function")
        if not in_file:
            _may_import_from(Path.cwd())
        module = guarded(text, lambda: _of_file(Path(source)) if in_file else importlib.import_module(source))
        target = getattr(module, name, None)
        if target is None:
            callables = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
            near = difflib.get_close_matches(name, callables, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(callables) or 'nothing to call'}"
            raise ConfigError(f"{source}: has no '{name}'; {hint}")
        if not callable(target):
            raise ConfigError(f"{text}: is a {type(target).__name__}; name a class, or a function of an image")
        return cls(text, name, target, module)

    @property
    def digest(self) -> str:
        """The hash of the file that holds it."""
        file = self.module.__file__
        return "" if file is None else file_digest(Path(file)).hex()

    def has(self, option: str) -> bool:
        """Return whether the call names this option; compiled code has no signature."""
        try:
            return option in inspect.signature(self.target).parameters
        except ValueError:
            return False

    def accepts(self, options: dict[str, Any], *more: Any) -> None:
        """Check the call with `more` and these options.

        Raises:
            ConfigError: If it cannot be called so.
        """
        try:
            inspect.signature(self.target).bind(*more, **options)
        except ValueError:  # compiled code has no signature
            return
        except TypeError as error:
            raise ConfigError(
                f"{self.text}: {error}; options are KEY=VALUE after its name, or --set KEY=VALUE"
            ) from error


def is_code(name: str) -> bool:
    """Return whether a name is the path of code, and not one of a registry."""
    return ":" in name or name.endswith(".py")


def absolute(name: str) -> str:
    """Return the name of code, its file's from the root of the file system."""
    source, _, what = name.rpartition(":")
    return f"{Path(source).expanduser().absolute()}:{what}" if source.endswith(".py") else name


# A run folder may come from anywhere: code that its settings name runs only where the user names it, too.

PROGRAMS = (".pt", ".pth", ".pt2")
"""Suffixes of network files that torch runs as programs."""

_allowed_only: ContextVar[tuple[str, frozenset[str]] | None] = ContextVar("_allowed_only", default=None)


def runs_code(name: str) -> bool:
    """Return whether what a name stands for runs code that semstab does not ship: a user's, or a network's program."""
    return is_code(name) or Path(name).suffix in PROGRAMS


def located(name: str) -> str:
    """Return the name of code or of a network's file, the file's from the root of the file system."""
    return str(Path(name).expanduser().absolute()) if Path(name).suffix in PROGRAMS else absolute(name)


@contextmanager
def only_named(where: str | Path, allowed: Collection[str]) -> Iterator[None]:
    """While the block lasts, refuse all code but that which the user named, for settings that stand in a file `where`.

    Threads that `semstab.core.prefetch` starts in the block are bound, too.
    """
    token = _allowed_only.set((str(where), frozenset(map(located, allowed))))
    try:
        yield
    finally:
        _allowed_only.reset(token)


def may_run(name: str) -> bool:
    """Return whether code may run here: outside of `only_named` any, inside of it what the user named."""
    bound = _allowed_only.get()
    return bound is None or not runs_code(name) or located(name) in bound[1]


def require_named(name: str, field: str = "") -> None:
    """Require that code may run here.

    Raises:
        ConfigError: If `may_run` returns False; the message names the file, the field in the file, and the code.
    """
    bound = _allowed_only.get()
    if bound is None or may_run(name):
        return
    source = f"{bound[0]}: {field}" if field else bound[0]
    raise ConfigError(
        f"{source} names code, which a run's folder does not start; where you trust it, add --code {located(name)}"
    )


def guarded(text: str, do: Callable[[], T]) -> T:
    """Run a user's code, and turn an error in it into one line with the position of the error.

    Modules that a file imports are searched next to this file first, then next to other files.
    """
    source = text.rpartition(":")[0]
    if source.endswith(".py"):
        _import_first_from(Path(source).expanduser().resolve().parent)
    try:
        with printing_aside():
            return do()
    except (ConfigError, DataError, MissingDependencyError):
        raise
    except ImportError as error:
        package = f"; install {error.name.partition('.')[0]}" if error.name else ""
        raise MissingDependencyError(
            f"{text}: it imports a missing module ({summarize_error(error)}){package}"
        ) from error
    except (Exception, SystemExit) as error:
        last = _users_own(text, traceback.extract_tb(error.__traceback__))
        at = f"{Path(last.filename).name}:{last.lineno}"
        if isinstance(error, SyntaxError):
            at = f"{Path(error.filename or '').name}:{error.lineno}"
        raise DataError(f"{text}: {type(error).__name__} at {at}: {summarize_error(error)}") from error


def _users_own(text: str, stack: Sequence[traceback.FrameSummary]) -> traceback.FrameSummary:
    """Return the innermost line in the folder of the user's code, if any: lines of torch are not the user's."""
    source = text.rpartition(":")[0]
    file = source if source.endswith(".py") else getattr(sys.modules.get(source), "__file__", None)
    folder = None if file is None else Path(file).expanduser().resolve().parent
    for frame in reversed(stack):
        path = Path(frame.filename).resolve()
        if folder is not None and folder in path.parents and "site-packages" not in path.relative_to(folder).parts:
            return frame
    return stack[-1]


def _of_file(path: Path) -> ModuleType:
    path = path.expanduser()
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file")
    content = hashlib.blake2b(str(path.resolve()).encode() + path.read_bytes(), digest_size=6).hexdigest()
    name = f"{path.stem}_{content}"  # a module of its own and of this version, whatever other files are called
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _may_import_from(folder: Path) -> None:
    """Append the folder to the search path, where nothing in it replaces an installed package."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
        _allowed.append(folder)


def _import_first_from(folder: Path) -> None:
    """Search the folder instead of those of other files, and forget modules of theirs that it has by the same name.

    Two networks from two repositories often have a `model.py` or a package `utils` each; a package without __init__.py
    would be found after a module of that name anywhere else.
    """
    if _searched[:1] == [folder] or (folder not in (*_searched, *_allowed) and str(folder) in sys.path):
        return
    other_folders = [other for other in (*_searched, *_allowed) if other != folder]
    module_names = {path.stem for other in other_folders if other.is_dir() for path in other.iterdir()}
    for name in {path.stem for path in folder.iterdir()} & module_names & set(sys.modules):
        module = sys.modules[name]
        places = list(getattr(module, "__path__", [module.__file__ or ""]))
        if any(Path(place).parent in other_folders for place in places):
            for part in [part for part in sys.modules if part.partition(".")[0] == name]:
                del sys.modules[part]
    sys.path[:] = [name for name in sys.path if Path(name) not in (*_searched, *_allowed)]
    _searched[:] = [folder, *(other for other in _searched if other != folder)]
    sys.path.extend(dict.fromkeys(map(str, (folder, *_allowed))))


_searched: list[Path] = []  # folders of users' files, that of the last one first, which alone is on the search path
_allowed: list[Path] = []  # folders that a program works in, which were appended for modules that are named
