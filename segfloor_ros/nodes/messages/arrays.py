"""Arrays as messages: images, their calibrations and the floor seen in them (mask, disparity,
scan); points as NumPy structured arrays (features, the sparse map, labelled points), the
occupancy grid, saved maps or parts of one, and which map a keyframe belongs to.
"""

from __future__ import annotations

import array
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage
from numpy.typing import NDArray
from sensor_msgs.msg import (
    CameraInfo,
    CompressedImage,
    Image,
    LaserScan,
    PointCloud2,
    PointField,
    TimeReference,
)
from std_msgs.msg import MultiArrayDimension, MultiArrayLayout, UInt8MultiArray
from stereo_msgs.msg import DisparityImage

from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.images import colour_image, depth_image, grey_image
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import (
    FloorObservation,
    FloorScan,
    KeyframeFeatures,
    LabelledPoints,
    MovingPoints,
    SparseCloud,
)
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.files.images import Grey
from segfloor_ros.core.files.results import FORMAT, from_bytes, to_bytes
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.nodes.messages.scans import free_ranges, near_obstacles
from segfloor_ros.nodes.messages.topics import make_header, to_ns, to_time

_XYZ = [('x', '<f4'), ('y', '<f4'), ('z', '<f4')]
FEATURE_DTYPE = np.dtype([*_XYZ, ('u', '<f4'), ('v', '<f4'), ('id', '<i4')])
MAP_POINT_DTYPE = np.dtype([*_XYZ, ('id', '<i4')])
LABELLED_DTYPE = np.dtype(
    [*_XYZ, ('id', '<i4'), ('confidence', '<f4'), ('label', 'u1'), ('_', 'V3')]
)

MOVING_DTYPE = np.dtype([*_XYZ, ('vx', '<f4'), ('vy', '<f4'), ('vz', '<f4')])

_FIELD_TYPES = {
    PointField.INT8: 'i1',
    PointField.UINT8: 'u1',
    PointField.INT16: 'i2',
    PointField.UINT16: 'u2',
    PointField.INT32: 'i4',
    PointField.UINT32: 'u4',
    PointField.FLOAT32: 'f4',
    PointField.FLOAT64: 'f8',
}
_DATATYPES = {np.dtype(code): datatype for datatype, code in _FIELD_TYPES.items()}

BEGUN, LOADED = 'stereo_slam', 'map file'

ENCODING_OF = {np.uint8: 'mono8', np.uint16: 'mono16', np.float32: '32FC1'}


def cloud_message(stamp_ns: int, frame_id: str, points: NDArray[np.void]) -> PointCloud2:
    """Return a structured array (N,) as an unordered cloud; padding fields named `_` are left out
    of its fields.
    """
    fields = [
        PointField(name=name, offset=int(offset), datatype=_DATATYPES[dtype], count=1)
        for name, (dtype, offset, *_) in (points.dtype.fields or {}).items()
        if name != '_'
    ]
    step = points.dtype.itemsize
    return PointCloud2(
        header=make_header(stamp_ns, frame_id),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(points),
        data=array.array('B', points.tobytes()),
        is_dense=bool(np.isfinite(points['x']).all()),
    )


def cloud_array(message: PointCloud2, wanted: np.dtype, topic: str) -> NDArray[np.void]:
    """Return the fields of `wanted` of a cloud as a structured array (N,).

    Raises InputError, naming the topic, when fields are missing or the sizes contradict.
    """
    order = '>' if message.is_bigendian else '<'
    by_name = {field.name: field for field in message.fields}
    names = [name for name in (wanted.names or ()) if name != '_']
    missing = [name for name in names if name not in by_name]
    if missing:
        raise InputError(f'{topic}: the cloud has no field {", ".join(missing)}')
    layout = np.dtype(
        {
            'names': names,
            'formats': [order + _field_type(by_name[name].datatype, topic) for name in names],
            'offsets': [by_name[name].offset for name in names],
            'itemsize': max(message.point_step, 1),
        }
    )
    raw = np.frombuffer(message.data, np.uint8)
    used = message.width * message.point_step
    if len(raw) != message.row_step * message.height or used > message.row_step:
        raise InputError(
            f'{topic}: {len(raw)} bytes do not make {message.height} rows of {message.width} '
            f'points of {message.point_step} bytes'
        )
    rows = raw.reshape(message.height, -1)[:, :used]
    return np.ascontiguousarray(rows).reshape(-1).view(layout)


def features_message(stamp_ns: int, frame_id: str, features: KeyframeFeatures) -> PointCloud2:
    """Return a keyframe's features as a cloud with x y z (NaN where unknown), u v and id."""
    u, v = features.uv_px.T
    points = _points(FEATURE_DTYPE, features.xyz_map, u=u, v=v, id=features.point_id)
    return cloud_message(stamp_ns, frame_id, points)


def features_arrays(message: PointCloud2, topic: str) -> KeyframeFeatures:
    """Return the features of a cloud. Raises InputError."""
    points = cloud_array(message, FEATURE_DTYPE, topic)
    uv = np.stack([points['u'], points['v']], axis=1).astype(np.float32)
    return KeyframeFeatures(uv, points['id'].astype(np.int32), _xyz(points))


def moving_points_message(stamp_ns: int, frame_id: str, moving: MovingPoints) -> PointCloud2:
    """Return points of what moves with their velocities."""
    vx, vy, vz = moving.velocity_m_s.T
    points = _points(MOVING_DTYPE, moving.xyz_map, vx=vx, vy=vy, vz=vz)
    return cloud_message(stamp_ns, frame_id, points)


def moving_points_arrays(message: PointCloud2, topic: str) -> MovingPoints:
    """Return the points of what moves. Raises InputError."""
    points = cloud_array(message, MOVING_DTYPE, topic)
    velocity = np.stack([points[name] for name in ('vx', 'vy', 'vz')], axis=1)
    return MovingPoints(_xyz(points), velocity.astype(np.float32))


def sparse_cloud_message(stamp_ns: int, frame_id: str, cloud: SparseCloud) -> PointCloud2:
    """Return the sparse map as a cloud with x y z and id."""
    points = _points(MAP_POINT_DTYPE, cloud.xyz_map, id=cloud.point_id)
    return cloud_message(stamp_ns, frame_id, points)


def sparse_cloud_arrays(message: PointCloud2, topic: str) -> SparseCloud:
    """Return the sparse map of a cloud. Raises InputError."""
    points = cloud_array(message, MAP_POINT_DTYPE, topic)
    return SparseCloud(points['id'].astype(np.int32), _xyz(points))


def labelled_message(stamp_ns: int, frame_id: str, labelled: LabelledPoints) -> PointCloud2:
    """Return the labelled points as a cloud with x y z id label confidence."""
    points = _points(LABELLED_DTYPE, labelled.xyz_map, id=labelled.point_id, label=labelled.label)
    points['confidence'] = labelled.confidence
    return cloud_message(stamp_ns, frame_id, points)


def labelled_arrays(message: PointCloud2, topic: str) -> LabelledPoints:
    """Return the labelled points of a cloud. Raises InputError."""
    points = cloud_array(message, LABELLED_DTYPE, topic)
    return LabelledPoints(
        points['id'].astype(np.int32),
        _xyz(points),
        points['label'].astype(np.uint8),
        points['confidence'].astype(np.float32),
    )


def points_at(
    stamp_ns: int, frame_id: str, labelled: LabelledPoints, rows: NDArray[np.intp]
) -> PointCloud2:
    """Return some rows (M,) of the points as a cloud with x y z and id."""
    cloud = SparseCloud(labelled.point_id[rows], labelled.xyz_map[rows])
    return sparse_cloud_message(stamp_ns, frame_id, cloud)


def _points(dtype: np.dtype, xyz: NDArray[np.floating], **columns: NDArray) -> NDArray[np.void]:
    points = np.zeros(len(xyz), dtype)
    points['x'], points['y'], points['z'] = xyz.T
    for name, values in columns.items():
        points[name] = values
    return points


def _xyz(points: NDArray[np.void]) -> NDArray[np.float32]:
    return np.stack([points['x'], points['y'], points['z']], axis=1).astype(np.float32)


def _field_type(datatype: int, topic: str) -> str:
    if datatype not in _FIELD_TYPES:
        raise InputError(f'{topic}: unknown field type {datatype} in the cloud')
    return _FIELD_TYPES[datatype]


def grid_message(stamp_ns: int, frame_id: str, grid: OccupancyGrid) -> OccupancyGridMessage:
    """Return the map; its origin is the outer corner of cell (0, 0)."""
    message = OccupancyGridMessage(header=make_header(stamp_ns, frame_id))
    rows, columns = grid.cells.shape
    message.info.map_load_time = to_time(stamp_ns)
    message.info.resolution = float(grid.resolution_m)
    message.info.width, message.info.height = columns, rows
    message.info.origin.position.x = float(grid.origin_xy_m[0])
    message.info.origin.position.y = float(grid.origin_xy_m[1])
    message.data = array.array('b', np.ascontiguousarray(grid.cells, np.int8).tobytes())
    return message


def grid_of(message: OccupancyGridMessage) -> OccupancyGrid:
    """Return the map of a message."""
    info = message.info
    cells = np.array(message.data, np.int8).reshape(info.height, info.width)
    origin = info.origin.position
    return OccupancyGrid(cells, float(info.resolution), (origin.x, origin.y))


def map_file_message(saved: MapFile) -> UInt8MultiArray:
    """Return a map, or a part of one, as the bytes of its file, not compressed."""
    data = array.array('B', to_bytes(saved, compress=False))
    size = MultiArrayDimension(label=FORMAT, size=len(data), stride=len(data))
    return UInt8MultiArray(layout=MultiArrayLayout(dim=[size]), data=data)


def map_file_of(message: UInt8MultiArray, topic: str) -> MapFile:
    """Return the map of a message. Raises InputError, by the topic's name, for other bytes."""
    return from_bytes(bytes(message.data), topic)


def map_start_message(
    stamp_ns: int, frame_id: str, start_ns: int, is_loaded: bool = False
) -> TimeReference:
    """Return that the keyframe of a stamp belongs to the map that was begun at `start_ns`.
    is_loaded: with what was loaded.
    """
    return TimeReference(
        header=make_header(stamp_ns, frame_id),
        time_ref=to_time(start_ns),
        source=LOADED if is_loaded else BEGUN,
    )


def map_start_ns(message: TimeReference) -> int:
    """Return when the keyframe's map was begun."""
    return to_ns(message.time_ref)


def is_of_loaded_map(message: TimeReference) -> bool:
    """Whether the keyframe's map goes on from a file."""
    return message.source == LOADED


def image_message(
    stamp_ns: int, frame_id: str, image: NDArray[np.generic], encoding: str = ''
) -> Image:
    """Return an image (H, W), or (H, W, 3) with its encoding, as a message; grey images of 8 and 16
    bits and disparities, float32, need none.
    """
    if not encoding:
        encoding = ENCODING_OF[image.dtype.type]
    pixels = np.ascontiguousarray(image)
    height, width = pixels.shape[:2]
    return Image(
        header=make_header(stamp_ns, frame_id),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=array.array('B', pixels.tobytes()),
    )


def compressed_message(
    stamp_ns: int, frame_id: str, image: NDArray[np.generic], jpeg_quality: int | None
) -> CompressedImage:
    """Return a grey image (H, W) as a message as image_transport makes it: JPEG of a quality of
    1 to 100, or PNG, without loss, where that is None or the image has 16 bits.
    """
    kind = 'png' if jpeg_quality is None or image.dtype == np.uint16 else 'jpeg'
    options = [] if kind == 'png' else [cv2.IMWRITE_JPEG_QUALITY, int(jpeg_quality or 0)]
    _, data = cv2.imencode(f'.{kind}', np.ascontiguousarray(image), options)
    encoding = 'mono16' if image.dtype == np.uint16 else 'mono8'
    return CompressedImage(
        header=make_header(stamp_ns, frame_id),
        format=f'{encoding}; {kind} compressed {encoding}',
        data=array.array('B', data.tobytes()),
    )


def grey8_image(message: Image, topic: str) -> NDArray[np.uint8]:
    """Return the grey image (H, W) of a message of 8 bits. Raises InputError."""
    return _eight_bit(grey_image(message, topic), message, topic)


def colour8_image(message: Image, topic: str) -> NDArray[np.uint8]:
    """Return the image of a message of 8 bits, (H, W, 3) BGR, or (H, W) where it has no colours.
    Raises InputError.
    """
    return _eight_bit(colour_image(message, topic), message, topic)


def _eight_bit(image: Grey, message: Image, topic: str) -> NDArray[np.uint8]:
    if image.dtype != np.uint8:
        raise InputError(f'{topic}: {message.encoding} has 16 bits, expected 8')
    return image.astype(np.uint8, copy=False)


def bgr_image(message: Image, topic: str) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) of a message of encoding bgr8. Raises InputError."""
    row = np.frombuffer(message.data, np.uint8)
    if message.encoding != 'bgr8' or len(row) != message.height * message.width * 3:
        raise InputError(f'{topic}: {message.encoding} or its size is not that of a bgr8 picture')
    return row.reshape(message.height, message.width, 3)


def right_image(message: Image, topic: str) -> NDArray[Any]:
    """Return the right image (H, W) uint8 of a message; of a depth camera the disparity (H, W)
    float32 in its place. Raises InputError.
    """
    if message.encoding != '32FC1':
        return grey8_image(message, topic)
    return depth_image(message, topic)


def camera_info_message(stamp_ns: int, frame_id: str, eye: EyeCalibration) -> CameraInfo:
    """Return the calibration of one eye; both eyes carry the left optical frame (REP-104: the
    right one's offset stands in P[3]).
    """
    return CameraInfo(
        header=make_header(stamp_ns, frame_id),
        width=int(eye.width),
        height=int(eye.height),
        distortion_model=eye.distortion_model,
        d=array.array('d', np.asarray(eye.D, np.float64).tobytes()),
        k=np.asarray(eye.K, np.float64).ravel(),
        r=np.asarray(eye.R, np.float64).ravel(),
        p=np.asarray(eye.P, np.float64).ravel(),
    )


def same_calibration(a: CameraInfo, b: CameraInfo) -> bool:
    """Return whether two messages hold the same calibration."""
    sizes = ((a.width, a.height), (b.width, b.height))
    return (
        sizes[0] == sizes[1]
        and a.distortion_model == b.distortion_model
        and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ('d', 'k', 'r', 'p'))
    )


def rectified_calibration(camera: StereoCamera) -> StereoCalibration:
    """Return the calibration of rectified images of a camera."""
    P = np.zeros((3, 4))
    P[:, :3] = camera.K
    left = EyeCalibration.of_rectified(camera.width, camera.height, P)
    P[0, 3] = -camera.disparity_times_depth
    right = EyeCalibration.of_rectified(camera.width, camera.height, P)
    return StereoCalibration(left, right)


def disparity_message(
    stamp_ns: int, frame_id: str, camera: StereoCamera, floor: FloorObservation
) -> DisparityImage:
    """Return the disparity image: Z = f * t / d; 0 where there is no match."""
    message = DisparityImage(
        header=make_header(stamp_ns, frame_id),
        image=image_message(stamp_ns, frame_id, floor.disparity_px, '32FC1'),
        f=float(camera.fx),
        t=float(camera.baseline_m),
        min_disparity=0.0,
        max_disparity=float(floor.max_disparity_px),
        delta_d=1.0 / 16.0,
    )
    message.valid_window.width, message.valid_window.height = camera.width, camera.height
    return message


def scan_message(stamp_ns: int, frame_id: str, scan: FloorScan) -> LaserScan:
    """Return the floor scan in the base's plane: how far the floor was seen, per bearing. The
    distances of upright things go into `intensities`, which stay empty where they are not known;
    those of what is of a class that moves follow them, where a network has looked. `range_max` is
    the range whose error is 0.3 m, one sigma.
    """
    ranges = np.ascontiguousarray(scan.ranges_m, np.float32)
    known = [one for one in (scan.obstacle_m, scan.movable_m) if one is not None]
    standing = np.concatenate([np.zeros(0, np.float32), *known])
    steps = max(len(ranges) - 1, 0)
    return LaserScan(
        header=make_header(stamp_ns, frame_id),
        angle_min=float(scan.angle_min_rad),
        angle_max=float(scan.angle_min_rad + steps * scan.angle_increment_rad),
        angle_increment=float(scan.angle_increment_rad),
        range_min=0.0,
        range_max=float(scan.range_max_m),
        ranges=array.array('f', ranges.tobytes()),
        intensities=array.array('f', standing.tobytes()),
    )


def free_scan_message(stamp_ns: int, frame_id: str, scan: FloorScan) -> LaserScan:
    """Return how far the floor is free per bearing, in the base's plane, for a costmap to clear:
    see `free_ranges`.
    """
    free = replace(scan, ranges_m=free_ranges(scan), obstacle_m=None, movable_m=None)
    return scan_message(stamp_ns, frame_id, free)


def obstacle_scan_message(stamp_ns: int, frame_id: str, scan: FloorScan) -> LaserScan:
    """Return what is near per bearing, in the base's plane, for a collision monitor: see
    `near_obstacles`.
    """
    ranges, reach_m = near_obstacles(scan)
    near = replace(scan, ranges_m=ranges, obstacle_m=None, range_max_m=reach_m, movable_m=None)
    return scan_message(stamp_ns, frame_id, near)


def scan_arrays(message: LaserScan, topic: str) -> FloorScan:
    """Return the floor scan of a message. Raises InputError, naming the topic."""
    if not message.range_max > 0:
        raise InputError(f'{topic}: range_max of the scan is {message.range_max:g} m')
    if not np.isfinite([message.angle_min, message.angle_increment]).all():
        raise InputError(f'{topic}: the angles of the scan are not finite')
    ranges = np.frombuffer(message.ranges, np.float32).copy()
    count, standing = len(ranges), np.frombuffer(message.intensities, np.float32).copy()
    if len(standing) not in (0, count, 2 * count):
        raise InputError(f'{topic}: {count} ranges, but {len(standing)} intensities')
    return FloorScan(
        float(message.angle_min),
        float(message.angle_increment),
        ranges,
        standing[:count] if len(standing) else None,
        float(message.range_max),
        standing[count:] if len(standing) > count else None,
    )
