"""Points as NumPy structured arrays: features, the sparse map, labelled and moving points."""

from __future__ import annotations

import array

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField

from segfloor_ros.core.contracts import KeyframeFeatures, LabelledPoints, MovingPoints, SparseCloud
from segfloor_ros.core.errors import InputError
from segfloor_ros.nodes.messages.making import make_header

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


_DATATYPES = {np.dtype(code): datatype for datatype, code in _FIELD_TYPES.items()}
