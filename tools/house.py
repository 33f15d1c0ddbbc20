"""How large the package is, by room: code lines, modules, named constants and the numbers in them.

    python -m tools.house

Code lines are those with code: no blanks, comments or docstrings. A constant is an assignment at
the top of a module whose value holds a number; `__init__` counts as a module.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

import segfloor_ros

PACKAGE = Path(segfloor_ros.__file__).parent
FIGURES = ('code lines', 'modules', 'constants', 'numbers in them')
NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER,
}  # fmt: skip
WITH_DOCSTRING = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def code_lines(text: str) -> int:
    """Return how many lines of a module hold code."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, WITH_DOCSTRING) and ast.get_docstring(node) is not None:
            lines.difference_update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    return len(lines)


def constants(text: str) -> tuple[int, int]:
    """Return the number of named constants of a module, and of the numbers in them."""
    assigned = (n.value for n in ast.parse(text).body if isinstance(n, (ast.Assign, ast.AnnAssign)))
    held = [
        sum(isinstance(n, ast.Constant) and type(n.value) in (int, float) for n in ast.walk(value))
        for value in assigned
        if value is not None
    ]
    return sum(count > 0 for count in held), sum(held)


def figures_of(module: Path) -> Counter[str]:
    """Return the figures of a module by name."""
    text = module.read_text()
    return Counter(dict(zip(FIGURES, (code_lines(text), 1, *constants(text)), strict=True)))


def main() -> None:
    """Print a line for each room, then their sum."""
    rooms: dict[str, Counter[str]] = {}
    for module in sorted(PACKAGE.rglob('*.py')):
        room = str(module.relative_to(PACKAGE).parent)
        rooms[room] = rooms.get(room, Counter()) + figures_of(module)
    rooms['sum'] = sum(rooms.values(), Counter())
    print(f'{"room":<20}', *(f'{name:>16}' for name in FIGURES))
    for room, figures in rooms.items():
        print(f'{room:<20}', *(f'{figures[name]:>16,}' for name in FIGURES))


if __name__ == '__main__':
    main()
