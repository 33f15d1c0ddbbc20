"""Fixtures shared by all tests."""

from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED_DATA = REPOSITORY.parent / 'shared' / 'data'


@pytest.fixture
def shared_data() -> Path:
    """Folder of real recordings beside the repository; where it is absent the test is skipped."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f'needs the recordings in {SHARED_DATA}, which are not part of the repository')
    return SHARED_DATA
