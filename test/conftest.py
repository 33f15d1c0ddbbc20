"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest

# Message fields of a wrong type must fail instead of being sent as garbage; read on import.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED_DATA = REPOSITORY.parent / 'shared' / 'data'


@pytest.fixture
def shared_data() -> Path:
    """Folder of real recordings beside the repository; where it is absent the test is skipped."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f'needs the recordings in {SHARED_DATA}, which are not part of the repository')
    return SHARED_DATA
