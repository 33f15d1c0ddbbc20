"""Which topics of a bag are the stereo pair."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os.path import commonpath

from segfloor_ros.camera.sources.sides import SIDES, side_pairs
from segfloor_ros.errors import InputError

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'

IMAGE_NAMES = (
    'image_rect',
    'image_rect_raw',
    'image_rect_color',
    'image_raw',
    'image_mono',
    'image_color',
    'image',
)
"""Usual last words of an image topic, the best first: rectified before raw, grey before colour."""

NO_PICTURES = ('depth', 'disparity', 'mask', 'keyframe', 'theora')
"""Words in the names of image topics that are no pictures, or not all of them."""


@dataclass(frozen=True)
class StereoTopics:
    """The image topics of both sides, and their CameraInfo topics, '' where there is none."""

    left: str
    right: str
    left_info: str
    right_info: str

    @property
    def is_rectified(self) -> bool:
        """Whether the names say that the images are rectified."""
        return all('image_rect' in topic for topic in (self.left, self.right))


def find_topics(name: str, types: Mapping[str, str], left: str, right: str) -> StereoTopics:
    """Return the stereo topics among those of a bag that hold messages.

    types: message type by topic. left, right: as the settings say, or '' to find them by name.
    Raises InputError listing the image topics when there is no pair.
    """
    images = sorted(t for t, kind in types.items() if kind in (IMAGE, COMPRESSED))
    listed = ', '.join(images) or 'none'
    for side, topic in (('left', left), ('right', right)):
        if topic and topic not in images:
            raise InputError(
                f'{name}: no images on {topic}; set stereo_camera.{side}_image_topic to one of its '
                f'image topics: {listed}'
            )
    if not (left and right):
        candidates = [pair for pair in side_pairs(images) if left in ('', pair[0])]
        candidates = [pair for pair in candidates if right in ('', pair[1])]
        pictures = [pair for pair in candidates if not any(w in pair[0] for w in NO_PICTURES)]
        if not pictures:
            raise InputError(
                f'{name}: no pair of left and right image topics (its image topics: {listed}); '
                'set stereo_camera.left_image_topic and right_image_topic'
            )
        left, right = min(pictures, key=_preference)
    infos = sorted(topic for topic, kind in types.items() if kind == CAMERA_INFO)
    return StereoTopics(left, right, _info_topic(left, infos, 0), _info_topic(right, infos, 1))


def _preference(pair: tuple[str, str]) -> tuple[int, int, int, str]:
    words = pair[0].split('/')
    compressed = words[-1] == 'compressed'
    name = words[-2 if compressed else -1]
    rank = IMAGE_NAMES.index(name) if name in IMAGE_NAMES else len(IMAGE_NAMES)
    return rank, int(compressed), len(words), pair[0]


def _info_topic(image: str, infos: list[str], side: int) -> str:
    """The CameraInfo beside the image, or else the nearest one whose name is not of the other
    side.
    """
    parent = image.removesuffix('/compressed').rpartition('/')[0]
    if f'{parent}/camera_info' in infos:
        return f'{parent}/camera_info'
    own = [words for words in SIDES if words[side] in image]
    near = [i for i in infos if any(words[side] in i for words in own)]
    return max(near, key=lambda info: len(commonpath([info, image])), default='')
