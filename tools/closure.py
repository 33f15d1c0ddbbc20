"""What one must load to understand a module: its import closure, in code lines.

    python -m tools.closure [MODULE…]

The closure holds the module, what it imports at module level, for types too, and what that
imports. Imports within functions do not count: a reader meets them where they are used. MODULE is
the end of a name, e.g. `slam.stereo_slam`.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import segfloor_ros
from tools.house import code_lines

PACKAGE = Path(segfloor_ros.__file__).parent
NAME = PACKAGE.name

ENTRIES = (
    'core.pipeline',
    'core.slam.stereo_slam',
    'core.floor.segmentation',
    'core.cloud',
    'core.grid.mapper',
    'nodes.stereo_camera',
    'nodes.stereo_slam',
    'nodes.floor_segmentation',
    'nodes.cloud_labelling',
    'nodes.occupancy_grid',
    'apps.cli.main',
)
"""Where a reader begins."""


def file_of(module: str) -> Path | None:
    """Return the file of a module or package by its full name, None where there is none."""
    path = PACKAGE.parent.joinpath(*module.split('.'))
    return next((p for p in (path.with_suffix('.py'), path / '__init__.py') if p.is_file()), None)


@cache
def imported_by(module: str) -> frozenset[str]:
    """Return the modules of the package that one imports at module level."""
    path = file_of(module)
    assert path is not None
    found: set[str] = set()
    for node in _at_module_level(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            base = node.module or ''
            names = [base, *(f'{base}.{alias.name}' for alias in node.names)]
        found.update(n for n in names if n.partition('.')[0] == NAME and file_of(n))
    return frozenset(found)


def _at_module_level(tree: ast.Module) -> Iterator[ast.Import | ast.ImportFrom]:
    todo: list[ast.AST] = list(tree.body)
    while todo:
        node = todo.pop()
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            yield node
        elif isinstance(node, (ast.If, ast.Try, ast.With, ast.ClassDef, ast.ExceptHandler)):
            for field in ('body', 'orelse', 'finalbody', 'handlers'):
                todo += getattr(node, field, [])


def closure(module: str) -> dict[str, int]:
    """Return the code lines of each module in the closure of one, by its name in the package."""
    found: dict[str, int] = {}
    todo = [f'{NAME}.{module}']
    while todo:
        name = todo.pop()
        path = file_of(name)
        if name not in found and path is not None:
            found[name] = code_lines(path.read_text())
            todo += [*imported_by(name), name.rpartition('.')[0]]
    return found


def circles() -> list[set[str]]:
    """Return the sets of modules that import one another, directly or by others."""
    names = {
        '.'.join(path.relative_to(PACKAGE.parent).with_suffix('').parts).removesuffix('.__init__')
        for path in PACKAGE.rglob('*.py')
    }
    reached = {name: _reached(name) for name in names}
    found: list[set[str]] = []
    for name in sorted(names):
        circle = {other for other in reached[name] if name in reached[other]}
        if circle and circle not in found:
            found.append(circle)
    return found


def _reached(module: str) -> set[str]:
    found: set[str] = set()
    todo = list(imported_by(module))
    while todo:
        name = todo.pop()
        if name not in found:
            found.add(name)
            todo += imported_by(name)
    return found


def main() -> None:
    """Print the closures of the given modules, or of all entries."""
    for module in sys.argv[1:] or ENTRIES:
        found = closure(module)
        print(f'{module:<28}{sum(found.values()):>8,} lines{len(found):>6} modules')


if __name__ == '__main__':
    main()
