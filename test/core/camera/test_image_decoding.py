"""Decoding of raw and compressed images; expected greys by hand (ITU-R BT.601 weights)."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from segfloor_ros.core.camera.images import EightBitScale, colour_image, grey_image, to_grey
from segfloor_ros.core.errors import CorruptImageError, InputError
from segfloor_ros.core.files.images import decode_file

RED, GREEN, BLUE = 200, 100, 50
GREY = round(0.299 * RED + 0.587 * GREEN + 0.114 * BLUE)


def raw(
    data: bytes, width: int, height: int, encoding: str, decode=grey_image, **fields: object
) -> np.ndarray:
    header = {'step': len(data) // max(height, 1), 'is_bigendian': 0, **fields}
    message = SimpleNamespace(data=data, width=width, height=height, encoding=encoding, **header)
    return decode(message, 'left')


@pytest.mark.parametrize('encoding', ['mono8', '8UC1'])
def test_grey_rows_end_where_the_padding_begins(encoding: str) -> None:
    image = raw(bytes([1, 2, 3, 99, 4, 5, 6, 99]), 3, 2, encoding)
    assert image.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ('big_endian', 'data'), [(False, [0x02, 0x01, 0x04, 0x03]), (True, [0x01, 0x02, 0x03, 0x04])]
)
@pytest.mark.parametrize('encoding', ['mono16', '16UC1'])
def test_sixteen_bits_in_both_orders(encoding: str, big_endian: bool, data: list[int]) -> None:
    image = raw(bytes(data), 2, 1, encoding, is_bigendian=big_endian)
    assert image.dtype == np.uint16
    assert image.tolist() == [[0x0102, 0x0304]]


@pytest.mark.parametrize(
    ('encoding', 'pixel'),
    [
        ('rgb8', [RED, GREEN, BLUE]),
        ('bgr8', [BLUE, GREEN, RED]),
        ('8UC3', [BLUE, GREEN, RED]),
        ('rgba8', [RED, GREEN, BLUE, 7]),
        ('bgra8', [BLUE, GREEN, RED, 7]),
    ],
)
def test_colour_becomes_grey(encoding: str, pixel: list[int]) -> None:
    image = raw(bytes(pixel * 6), 3, 2, encoding)
    assert image.shape == (2, 3)
    assert np.abs(image.astype(int) - GREY).max() <= 1
    colour = raw(bytes(pixel * 6), 3, 2, encoding, colour_image)
    assert colour.tolist() == [[[BLUE, GREEN, RED]] * 3] * 2


@pytest.mark.parametrize('encoding', ['yuv422', 'yuyv', 'bayer_rggb8', 'bayer_grbg8'])
def test_red_is_red_in_every_order(encoding: str) -> None:
    # Red has a high V; in a Bayer pattern it is where its letter stands.
    data = {
        'yuv422': [90, 80, 240, 80] * 8,
        'yuyv': [80, 90, 80, 240] * 8,
        'bayer_rggb8': ([250, 0] * 4 + [0, 0] * 4) * 2,
        'bayer_grbg8': ([0, 250] * 4 + [0, 0] * 4) * 2,
    }[encoding]
    width = 4 if encoding.startswith('y') else 8
    blue, green, red = raw(bytes(data), width, 4, encoding, colour_image)[1:3, 1:3].mean((0, 1))
    assert red > 100 and max(blue, green) < 40


def test_grey_stays_grey_where_colours_are_asked_for() -> None:
    assert raw(bytes([1, 2, 3, 4]), 2, 2, 'mono8', colour_image).tolist() == [[1, 2], [3, 4]]
    with pytest.raises(InputError, match='encoding jpeg is not supported'):
        raw(b'', 0, 0, 'jpeg', colour_image)


@pytest.mark.parametrize(
    ('encoding', 'data'),
    [
        ('yuv422', [128, 10, 128, 20, 90, 30, 160, 40]),
        ('uyvy', [128, 10, 128, 20, 90, 30, 160, 40]),
        ('yuv422_yuy2', [10, 128, 20, 128, 30, 90, 40, 160]),
        ('yuyv', [10, 128, 20, 128, 30, 90, 40, 160]),
    ],
)
def test_yuv_gives_its_luminance(encoding: str, data: list[int]) -> None:
    assert raw(bytes(data), 2, 2, encoding).tolist() == [[10, 20], [30, 40]]


SCENES = {
    'dark': (18, 18, (130, 126), (126, 130)),
    'overexposed': (255, 255, (128, 128), (129, 127)),
    'red beside blue': (82, 60, (90, 240), (240, 110)),
    'terracotta before grey': (110, 125, (105, 155), (128, 128)),
}
"""Brightness of the left and the right half of an image, and (U, V) of each."""


@pytest.mark.parametrize('encoding', ['yuyv', 'uyvy'])
@pytest.mark.parametrize('scene', SCENES)
def test_images_of_little_contrast_keep_their_brightness(encoding: str, scene: str) -> None:
    left, right, *colours = SCENES[scene]
    rng = np.random.default_rng(3)
    y = np.repeat([left, right], 32)[None].repeat(48, 0) + rng.integers(0, 2, (48, 64))
    uv = np.repeat(np.array(colours)[:, None], 16, 1).reshape(1, 64).repeat(48, 0)
    uv = uv + rng.integers(-1, 2, uv.shape)
    channels = (y, uv) if encoding == 'yuyv' else (uv, y)
    data = np.clip(np.stack(channels, axis=2), 0, 255).astype(np.uint8)
    grey = raw(data.tobytes(), 64, 48, encoding)
    np.testing.assert_array_equal(grey, np.clip(y, 0, 255))


@pytest.mark.parametrize('bits', [8, 16])
@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_bayer_mosaic_of_one_colour_is_one_grey(pattern: str, bits: int) -> None:
    scale = 1 if bits == 8 else 256
    colours = {'r': RED * scale, 'g': GREEN * scale, 'b': BLUE * scale}
    tile = np.array([colours[letter] for letter in pattern]).reshape(2, 2)
    mosaic = np.tile(tile, (4, 5)).astype(np.uint8 if bits == 8 else np.uint16)
    image = raw(mosaic.tobytes(), 10, 8, f'bayer_{pattern}{bits}')
    assert image.shape == (8, 10)
    assert np.abs(image[2:-2, 2:-2].astype(int) - GREY * scale).max() <= scale


@pytest.mark.parametrize(
    ('data', 'width', 'height', 'step'),
    [(11, 4, 3, 4), (13, 4, 3, 4), (12, 5, 3, 4), (12, 0, 3, 4), (0, 4, 0, 4)],
)
def test_data_that_contradicts_the_header_is_refused(
    data: int, width: int, height: int, step: int
) -> None:
    with pytest.raises(CorruptImageError, match=f'left: {data} bytes do not make a'):
        raw(bytes(data), width, height, 'mono8', step=step)


def test_encodings_that_are_no_pictures_are_refused() -> None:
    with pytest.raises(InputError, match='left: image encoding 32FC1 is not supported'):
        raw(bytes(4), 1, 1, '32FC1')


def picture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8)
    return cv2.GaussianBlur(noise, (5, 5), 0)


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def test_png_is_exact_in_8_and_16_bits() -> None:
    image = picture()
    deep = image.astype(np.uint16) * 257
    np.testing.assert_array_equal(decode_file(encoded('.png', image), 'left'), image)
    np.testing.assert_array_equal(decode_file(encoded('.png', deep), 'left'), deep)


@pytest.mark.parametrize('suffix', ['.png', '.jpg'])
def test_truncated_images_are_refused(suffix: str) -> None:
    data = encoded(suffix, picture())
    for part in (0.02, 0.5, 0.97):
        with pytest.raises(CorruptImageError, match=r'left: the \w+ is truncated'):
            decode_file(data[: int(part * len(data))], 'left')


def test_zeros_after_a_jpeg_are_padding() -> None:
    data = encoded('.jpg', picture())
    np.testing.assert_array_equal(
        decode_file(data + bytes(5000), 'left'), decode_file(data, 'left')
    )


def test_damaged_png_is_refused() -> None:
    data = bytearray(encoded('.png', picture()))
    data[len(data) // 2] ^= 0xFF
    with pytest.raises(CorruptImageError, match='left: the PNG is damaged'):
        decode_file(bytes(data), 'left')


@pytest.mark.parametrize(('data', 'message'), [(b'', 'empty'), (b'not an image', 'be decoded')])
def test_data_that_is_no_image_is_refused(data: bytes, message: str) -> None:
    with pytest.raises(CorruptImageError, match=message):
        decode_file(data, 'left')


def test_the_scale_is_one_for_both_eyes_and_all_pairs() -> None:
    scale = EightBitScale()
    bright = np.array([[4095, 16]], np.uint16)  # 12 bits: 255 at 4095, and the root of it at 16
    dark = np.array([[1024, 16]], np.uint16)
    assert [image.tolist() for image in scale(bright, dark)] == [[[255, 16]], [[128, 16]]]
    assert [image.tolist() for image in scale(dark, dark)] == [[[128, 16]], [[128, 16]]]


def test_a_recording_that_begins_in_the_dark_does_not_saturate() -> None:
    scale = EightBitScale()
    scale(*[np.array([[9, 3]], np.uint16)] * 2)
    day = np.array([[4000, 1000]], np.uint16)
    grey = scale(day, day)[0][0].astype(int)
    assert grey[0] > 250
    assert 120 < grey[1] < 130


def test_the_steps_of_the_scale_are_those_of_the_noise_of_light() -> None:
    """One grey level is the same part of the noise, the root of the light, dark or bright."""
    scale = EightBitScale()
    scale(*[np.array([[4095]], np.uint16)] * 2)  # 12 bits
    for light in (256, 1024, 2304):
        noise = np.array([[light, light + round(3 * light**0.5)]], np.uint16)
        dark, bright = scale(noise, noise)[0][0].astype(int)
        assert bright - dark == pytest.approx(3 * 255 / 2 / 4095**0.5, abs=1)


def test_eight_bits_in_sixteen_are_those_of_the_camera() -> None:
    image = np.array([[7, 100, 255]], np.uint16)
    assert EightBitScale()(image, image)[0].tolist() == image.tolist()


def test_eight_bits_pass_through() -> None:
    left, right = np.zeros((2, 2), np.uint8), np.ones((2, 2), np.uint8)
    scaled = EightBitScale()(left, right)
    assert scaled[0] is left
    assert scaled[1] is right


def test_grey_of_one_channel_is_the_channel() -> None:
    image = np.arange(6, dtype=np.uint8).reshape(2, 3, 1)
    np.testing.assert_array_equal(to_grey(image), image[:, :, 0])
