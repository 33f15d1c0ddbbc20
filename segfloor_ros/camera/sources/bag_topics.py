"""Which topics of a bag are the stereo pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os.path import commonpath

from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources.sides import SIDES, is_side, side_pairs
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

COLOUR = ('color', 'colour', 'rgb')
REGISTERED = ('color', 'registered', 'rgb')
"""Words in the names of depth topics that are aligned with the colour images."""

NO_PICTURES = ('depth', 'disparity', 'mask', 'keyframe', 'theora')
"""Words in the names of image topics that are no pictures, or not all of them."""


@dataclass(frozen=True)
class StereoTopics:
    """The image topics of both sides, and their CameraInfo topics, '' where there is none. The
    right one may be that of the depth images that belong to the left.
    """

    left: str
    right: str
    left_info: str
    right_info: str
    right_is_depth: bool = False

    @property
    def is_rectified(self) -> bool:
        """Whether the names say that the images are rectified."""
        images = (self.left,) if self.right_is_depth else (self.left, self.right)
        return all('image_rect' in topic for topic in images)


def check_given(name: str, topic: str, found: Sequence[str], what: str, setting: str) -> None:
    """Raise InputError where a topic that a setting names is not among those found in a bag."""
    if topic and topic not in found:
        raise InputError(
            f'{name}: no {what} on {topic}; set stereo_camera.{setting} to one of these: '
            f'{", ".join(found) or "none"}'
        )


def find_topics(name: str, types: Mapping[str, str], left: str, right: str) -> StereoTopics:
    """Return the stereo topics among those of a bag that hold messages.

    types: message type by topic. left, right: as the settings say, or '' to find them by name.
    Raises InputError listing the image topics when there is no pair.
    """
    images = sorted(t for t, kind in types.items() if kind in (IMAGE, COMPRESSED))
    for side, topic in (('left', left), ('right', right)):
        check_given(name, topic, images, 'images', f'{side}_image_topic')
    if not (left and right):
        candidates = [pair for pair in side_pairs(images) if left in ('', pair[0])]
        candidates = [pair for pair in candidates if right in ('', pair[1])]
        pictures = [pair for pair in candidates if not any(w in pair[0] for w in NO_PICTURES)]
        if not pictures:
            listed = ', '.join(images) or 'none'
            raise InputError(
                f'{name}: no pair of left and right image topics (its image topics: {listed}); '
                'set stereo_camera.left_image_topic and right_image_topic; one camera alone does '
                'not tell how far away anything is'
            )
        left, right = min(pictures, key=_preference)
    infos = sorted(topic for topic, kind in types.items() if kind == CAMERA_INFO)
    return StereoTopics(left, right, _info_topic(left, infos, 0), _info_topic(right, infos, 1))


def has_pair(types: Mapping[str, str], settings: StereoCameraSettings) -> bool:
    """Whether a bag holds a pair of left and right images."""
    try:
        find_topics('', types, settings.left_image_topic, settings.right_image_topic)
    except InputError:
        return False
    return True


def find_depth_topics(
    name: str, types: Mapping[str, str], settings: StereoCameraSettings
) -> StereoTopics | None:
    """Return the depth topic of a bag with that of the images it is aligned with: the colour
    camera's where its name says so or there is no left one. None where there is none.
    """
    images = sorted(t for t, kind in types.items() if kind in (IMAGE, COMPRESSED))
    depth = [t for t in images if types[t] == IMAGE and 'depth' in t.lower()]
    check_given(name, settings.depth_topic, depth, 'depth images', 'depth_topic')
    depth = [settings.depth_topic] if settings.depth_topic else depth
    pictures = [t for t in images if not any(word in t.lower() for word in NO_PICTURES)]
    if not depth or not pictures:
        return None
    best = min(depth, key=lambda t: (not any(w in t for w in REGISTERED), len(t), t))
    colour = [t for t in pictures if any(word in t.lower() for word in COLOUR)]
    left = [t for t in pictures if is_side(t, 0) or 'infra1' in t]
    wanted = colour if any(word in best.lower() for word in REGISTERED) else left or colour
    picture = settings.left_image_topic or min(wanted or pictures, key=lambda t: _rank(t))
    infos = sorted(topic for topic, kind in types.items() if kind == CAMERA_INFO)
    return StereoTopics(picture, best, _info_topic(picture, infos, 0), '', right_is_depth=True)


def _rank(topic: str) -> tuple[int, int, int, str]:
    return _preference((topic, topic))


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
