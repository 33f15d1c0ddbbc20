"""What the nodes ask of the middleware beyond quality of service, which has no word for it."""

from __future__ import annotations

import os
from pathlib import Path

PROFILES = Path(__file__).with_name('fastdds.xml')
"""Shared memory for stereo images and prompt repetition of what was lost, for Fast DDS, the
default middleware of ROS 2 Jazzy. Other middlewares do not read it.
"""

NAMED_BY = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_OTHERS = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS')
_IN_FOLDER = ('DEFAULT_FASTRTPS_PROFILES.xml', 'DEFAULT_FASTDDS_PROFILES.xml')


def prepare_middleware() -> None:
    """Let Fast DDS take `PROFILES` in this process, unless the user has chosen otherwise. Before
    `rclpy.init`.
    """
    is_chosen = any(os.environ.get(name) for name in (NAMED_BY, *_OTHERS))
    if not is_chosen and not any(Path(name).exists() for name in _IN_FOLDER):
        os.environ[NAMED_BY] = str(PROFILES)
