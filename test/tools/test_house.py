"""The size of the package, counted on a module of a few lines."""

import pytest

from tools.house import code_lines, constants, main

MODULE = '''"""What it is for."""

LIMIT = 3  # a comment
PAIR: tuple[float, int] = (1.5, -2)
"""Said of both."""
NAMES = ('a', 'b')
IS_SO = True


def double(x: int) -> int:
    """Return twice as much."""
    # So it is.
    return (
        2 * x
    )
'''


def test_blanks_comments_and_docstrings_are_no_code() -> None:
    assert code_lines(MODULE) == 9


def test_constants_hold_numbers() -> None:
    assert constants(MODULE) == (2, 3)


@pytest.mark.slow
def test_rooms_add_up(capsys) -> None:
    main()
    heading, *rooms, total = (line.split() for line in capsys.readouterr().out.splitlines())
    assert heading[0] == 'room' and {'.', 'core/slam', 'nodes/shared'} <= {
        room[0] for room in rooms
    }
    for column in range(1, 5):
        numbers = [int(line[column].replace(',', '')) for line in (*rooms, total)]
        assert sum(numbers[:-1]) == numbers[-1] > 100
