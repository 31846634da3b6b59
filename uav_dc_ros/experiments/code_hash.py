"""Hash of the code that a result depends on: a result of other code is not taken for one of this."""

import ast
import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import uav_dc_ros
from uav_dc_ros import __version__


def code_hash_of(root: Path, modules: Sequence[str]) -> str:
    """Hash of modules, and of all that they import, of the package in the folder `root`."""
    digest = hashlib.sha256(__version__.encode())
    for name in sorted(import_closure(root, modules)):
        digest.update(name.encode() + file_of(root, name).read_bytes())
    return digest.hexdigest()[:16]


def import_closure(root: Path, modules: Sequence[str]) -> set[str]:
    """Full names of modules and of all modules of this package that they import, directly or not.

    Imports are found in the source in the folder `root`, inside functions too. Those for type checkers are
    left out, and so is the package's own file, which defines the version and imports nothing.
    """
    found: set[str] = set()
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name in found or name == uav_dc_ros.__name__ or not file_of(root, name).is_file():
            continue
        found.add(name)
        waiting += _imports(ast.parse(file_of(root, name).read_bytes()))
    return found


def file_of(root: Path, module: str) -> Path:
    """The file of a module of the package in the folder `root`."""
    path = root.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _imports(tree: ast.AST) -> Iterator[str]:
    """Full names of what may be modules of this package."""
    for node in ast.iter_child_nodes(tree):
        match node:
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                for other in node.orelse:
                    yield from _imports(other)
            case ast.Import():
                yield from (alias.name for alias in node.names if _is_own(alias.name))
            case ast.ImportFrom(module=str(module)) if _is_own(module):
                yield module
                yield from (f"{module}.{alias.name}" for alias in node.names)
            case _:
                yield from _imports(node)


def _is_own(module: str) -> bool:
    return module.partition(".")[0] == uav_dc_ros.__name__
