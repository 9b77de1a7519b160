"""Check types and shapes at run time wherever one room of the package is called by another.

Checked are the functions and classes that a package shows in its `__init__` or lists in its stub,
and their public methods. Inner functions are the type checker's business: checking them too takes a
sixth of the tests' time.
"""

import ast
import functools
import hashlib
import marshal
import os
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable
from contextlib import suppress
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType

import jax
import numpy as np
from beartype import beartype
from jaxtyping import jaxtyped

PACKAGE = Path(__file__).parent.parent / "smartview_jax"

CHECKED = PACKAGE.parent / ".pytest_cache" / "checked_modules"
"""The folder of compiled modules with their checks: to add them takes longer than to read them."""

_OWN_SOURCE = Path(__file__).read_bytes()

_IMPORTS = ast.parse("import public_signatures as _public_signatures").body
_CHECK_FUNCTION = ast.parse("_public_signatures.checked", mode="eval").body
_CHECK_CLASS = ast.parse("_public_signatures.checked_class", mode="eval").body

checked_class = jaxtyped(typechecker=beartype)


def checked(function: Callable) -> Callable:
    """Check the types and shapes of a function's arguments and result.

    A call with arguments of the same types and shapes as an earlier one is not checked again: to do
    so takes a tenth of the tests' time. The checks are made at the first call, since a worker calls
    few of the functions that it imports.
    """
    checks = None
    known = set()

    @functools.wraps(function)
    def call(*args, **kwargs):
        kinds = (*map(_kind, args), *((name, _kind(value)) for name, value in kwargs.items()))
        if kinds in known:
            return function(*args, **kwargs)
        nonlocal checks
        checks = checks or jaxtyped(typechecker=beartype)(function)
        result = checks(*args, **kwargs)
        known.add(kinds)
        return result

    return call


def _kind(argument: object) -> object:
    """What a check of an argument depends on."""
    if isinstance(argument, np.ndarray | jax.Array):
        return type(argument), argument.shape, argument.dtype
    if isinstance(argument, tuple | list):
        return type(argument), *map(_kind, argument)
    return type(argument)


def shown_names(package: Path = PACKAGE) -> dict[str, set[str]]:
    """Names that any package shows, by the full name of the module that it takes them from."""
    shown = defaultdict(set)
    for file in package.rglob("__init__.py*"):
        folder = file.parent.relative_to(package.parent).parts
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.level:
                outer = folder[: len(folder) - node.level + 1]
                module = ".".join([*outer, *([node.module] if node.module else [])])
                shown[module] |= {alias.name for alias in node.names}
    return shown


class _AddChecks(ast.NodeTransformer):
    """Decorates the public functions, and the public methods of the public classes, of a module."""

    def __init__(self, public: set[str]) -> None:
        self._public = public

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        if node.name in self._public:
            # Innermost, because other decorators, such as `jax.custom_jvp`, need their own methods.
            node.decorator_list.append(_CHECK_FUNCTION)
        return node

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.ClassDef:
        if node.name in self._public:
            node.decorator_list.insert(0, _CHECK_CLASS)
            methods = _AddChecks({part.name for part in node.body if _is_public_method(part)})
            node.body = [methods.visit(part) for part in node.body]
        return node


def _is_public_method(part: ast.stmt) -> bool:
    is_special = isinstance(part, ast.FunctionDef) and part.name.endswith("__")
    return isinstance(part, ast.FunctionDef) and (is_special or not part.name.startswith("_"))


class _Loader(SourceFileLoader):
    """Compiles a module with its checks, and keeps it where only the tests look for it."""

    def __init__(self, name: str, path: str, public: set[str]) -> None:
        super().__init__(name, path)
        self._public = public

    def get_code(self, fullname: str):
        path = self.get_filename(fullname)
        source = self.get_data(path)
        decided_by = repr((path, source, sorted(self._public), _OWN_SOURCE, sys.version))
        kept = CHECKED / f"{fullname}-{hashlib.sha256(decided_by.encode()).hexdigest()}"
        with suppress(OSError, ValueError, EOFError, TypeError):
            return marshal.loads(kept.read_bytes())
        code = self._with_checks(source, path)
        with suppress(OSError):
            _replace(CHECKED.glob(f"{fullname}-*"), kept, marshal.dumps(code))
        return code

    def _with_checks(self, source: bytes, path: str) -> CodeType:
        tree = _AddChecks(self._public).visit(ast.parse(source, path))
        # After the module's docstring, if it has one.
        has_docstring = ast.get_docstring(tree) is not None
        tree.body[has_docstring:has_docstring] = _IMPORTS
        # What is added was parsed as well, and so has a place in some file: none is missing.
        return compile(tree, path, "exec", dont_inherit=True)


def _replace(old: Iterable[Path], file: Path, content: bytes) -> None:
    """Write a file in the place of older ones; another worker reads all of it or nothing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    for other in old:
        other.unlink(missing_ok=True)
    unfinished = file.with_name(f"{os.getpid()}-{file.name}")
    unfinished.write_bytes(content)
    unfinished.replace(file)


class _Finder(MetaPathFinder):
    def __init__(self) -> None:
        self._shown = shown_names()

    def find_spec(self, fullname, path=None, target=None):
        if fullname not in self._shown:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path, self._shown[fullname])
        return spec


def check_public_signatures() -> None:
    """Check all modules of the package that are imported from now on."""
    if "smartview_jax" in sys.modules:
        raise RuntimeError("smartview_jax is imported already: its signatures cannot be checked")
    sys.meta_path.insert(0, _Finder())
