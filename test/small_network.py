"""Small networks as ONNX files: one that tells grey levels apart, and one that is fitted to the
pictures of a simulated drive.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from segfloor_ros.nodes.network_files import open_network

onnx = pytest.importorskip('onnx')
helper, numpy_helper, TensorProto = onnx.helper, onnx.numpy_helper, onnx.TensorProto


def write_network(path: Path, nodes, weights, input_shape, outputs, **settings) -> Path:
    """Write a graph and its YAML. weights: arrays by name; outputs: shapes by name."""

    def info(name, shape):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    for node in nodes:
        if node.op_type == 'Conv':  # older OpenCV asks for it
            kernel = list(np.shape(weights[node.input[1]])[2:])
            node.attribute.append(helper.make_attribute('kernel_shape', kernel))
    graph = helper.make_graph(
        nodes,
        'small',
        [info('image', input_shape)],
        [info(name, shape) for name, shape in outputs.items()],
        [
            numpy_helper.from_array(np.ascontiguousarray(w, np.float32), name)
            if np.asarray(w).dtype.kind == 'f'
            else numpy_helper.from_array(np.asarray(w, np.int64), name)
            for name, w in weights.items()
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 11)], ir_version=6)
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, str(path))
    path.with_suffix('.yaml').write_text(yaml.safe_dump(settings))
    return path


def conv(data: str, out: str, weight: str, bias: str, **attributes):
    return helper.make_node('Conv', [data, weight, bias], [out], **attributes)


def grey_network(path: Path, width=16, height=8, **changes) -> Path:
    """A network that calls what is darker than half `dark`, the rest `light`."""
    settings = {
        'kind': 'semantic',
        'input': [width, height],
        'classes': ['dark', 'light'],
        'mean': [127.5],
        'scale': [1.0],
    }
    return write_network(
        path,
        [conv('image', 'scores', 'w', 'b')],
        {'w': np.array([-1.0, 1.0]).reshape(2, 1, 1, 1), 'b': np.zeros(2)},
        [1, 1, height, width],
        {'scores': [1, 2, height, width]},
        **(settings | changes),
    )


def constant_network(path: Path, chosen: str, classes, **changes) -> Path:
    """A network that sees one class everywhere."""
    scores = np.array([float(name == chosen) for name in classes])
    settings = {'kind': 'semantic', 'input': [32, 24], 'classes': list(classes), 'mean': [0.0]}
    return write_network(
        path,
        [conv('image', 'scores', 'w', 'b')],
        {'w': np.zeros((len(classes), 1, 1, 1)), 'b': scores},
        [1, 1, 24, 32],
        {'scores': [1, len(classes), 24, 32]},
        **(settings | changes),
    )


FEATURES = (24, 48)
"""Of both layers of fixed random filters."""


class FittedNetwork:
    """A network of fixed random filters whose last layer, the classifier, is fitted to pictures
    with true labels by ridge regression: no more than NumPy and a second are needed.
    """

    def __init__(self, width: int, height: int, classes, seed: int = 0, **settings) -> None:
        rng = np.random.default_rng(seed)
        first, second = FEATURES
        w1 = rng.standard_normal((first, 1, 5, 5))
        w1 -= w1.mean(axis=(2, 3), keepdims=True)
        w1[::4] = np.abs(rng.standard_normal((len(w1[::4]), 1, 5, 5)))  # brightness
        w1 /= np.sqrt((w1**2).sum(axis=(1, 2, 3), keepdims=True))
        w2 = rng.standard_normal((second, first, 3, 3)) / np.sqrt(9 * first)
        row = np.linspace(-1, 1, height // 4)[None, None, :, None]
        column = np.linspace(-1, 1, width // 4)[None, None, None, :]
        place = np.broadcast_to(row, (1, 1, height // 4, width // 4))
        place = np.concatenate([place, place**2, np.broadcast_to(column**2, place.shape)], axis=1)
        self.classes, self.size = list(classes), (width, height)
        self.weights = {
            'w1': w1, 'b1': rng.uniform(-0.3, 0.3, first),
            'w2': w2, 'b2': rng.uniform(-0.3, 0.3, second),
            'place': place,
        }  # fmt: skip
        self.settings = {
            'kind': 'semantic', 'input': [width, height], 'classes': self.classes,
            'mean': [110.0], 'scale': [1 / 50], **settings,
        }  # fmt: skip

    def _nodes(self):
        smooth = {'kernel_shape': [5, 5], 'pads': [2, 2, 2, 2], 'strides': [1, 1]}
        return [
            conv('image', 'c1', 'w1', 'b1', strides=[2, 2], pads=[2, 2, 2, 2]),
            helper.make_node('Relu', ['c1'], ['r1']),
            conv('r1', 'c2', 'w2', 'b2', strides=[2, 2], pads=[1, 1, 1, 1]),
            helper.make_node('Relu', ['c2'], ['r2']),
            helper.make_node('AveragePool', ['r2'], ['around'], **smooth),
            helper.make_node('AveragePool', ['around'], ['wide'], **smooth),
            helper.make_node('Concat', ['r2', 'around', 'wide', 'place'], ['features'], axis=1),
        ]

    def fit(self, images, labels, folder: Path) -> None:
        """Fit the classifier to images (N, H, W) and true numbers of classes (N, H, W)."""
        width, height = self.size
        count = 3 * FEATURES[1] + self.weights['place'].shape[1]
        shape = [1, count, height // 4, width // 4]
        file = write_network(
            folder / 'features.onnx', self._nodes(), self.weights, [1, 1, height, width],
            {'features': shape}, kind='semantic', input=[width, height], mean=[0.0],
            classes=[str(i) for i in range(count)],
        )  # fmt: skip
        features = open_network(file)
        gram = np.zeros((count + 1, count + 1))
        towards = np.zeros((count + 1, len(self.classes)))
        for image, numbers in zip(images, labels, strict=True):
            pixels = cv2.resize(image, self.size, interpolation=cv2.INTER_AREA)
            given = (pixels[None, None].astype(np.float32) - 110) / np.float32(50)
            x = features._run(given)[0].reshape(count, -1).T
            x = np.hstack([x, np.ones((len(x), 1))])
            small = cv2.resize(numbers, shape[:1:-1], interpolation=cv2.INTER_NEAREST).ravel()
            known = small < len(self.classes)
            x, small = x[known], small[known]
            # Each class counts alike, whatever its share of the picture.
            weight = 1 / np.bincount(small, minlength=len(self.classes)).clip(50)[small]
            gram += x.T @ (x * weight[:, None])
            towards += (x * weight[:, None]).T @ np.eye(len(self.classes))[small]
        self.readout = np.linalg.solve(gram + 1e-4 * np.eye(count + 1), towards).T

    def write(self, path: Path) -> Path:
        """Write the fitted network."""
        width, height = self.size
        shape = [1, len(self.classes), height // 4, width // 4]
        weights = self.weights | {'w3': self.readout[:, :-1, None, None], 'b3': self.readout[:, -1]}
        nodes = [*self._nodes(), conv('features', 'scores', 'w3', 'b3')]
        return write_network(
            path, nodes, weights, [1, 1, height, width], {'scores': shape}, **self.settings
        )
