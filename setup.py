"""Build description for pip and for colcon (ament_python)."""

import os
import re
import sys
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = 'segfloor_ros'
PROGRAMS = {
    'segfloor': 'apps.cli:start',
    'stereo_camera': 'apps.programs:stereo_camera',
    'stereo_slam': 'apps.programs:stereo_slam',
    'floor_segmentation': 'apps.programs:floor_segmentation',
    'cloud_labelling': 'apps.programs:cloud_labelling',
    'occupancy_grid': 'apps.programs:occupancy_grid',
    'segfloor_pipeline': 'apps.programs:segfloor_pipeline',
    'simulated_robot': 'apps.programs:simulated_robot',
    'segfloor_masks': 'apps.programs:segfloor_masks',
}
HERE = Path(__file__).resolve().parent
VERSION = re.search(r"__version__ = '(.+)'", (HERE / PACKAGE / '__init__.py').read_text())[1]


def files(folder, *patterns):
    """Return the files of a folder as paths relative to this one, as data_files wants them."""
    found = [path for pattern in patterns for path in sorted((HERE / folder).glob(pattern))]
    return [str(path.relative_to(HERE)) for path in found]


data_files = [
    ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
    (f'share/{PACKAGE}', ['package.xml']),
    (f'share/{PACKAGE}/launch_configs', files('launch_configs', '*.launch.py', '*.rviz', '*.json')),
    (
        f'share/{PACKAGE}/params',
        [*files('params', '*.yaml', '*.xml'), f'{PACKAGE}/nodes/fastdds.xml'],
    ),
]
if 'install' in sys.argv or 'develop' in sys.argv:
    # colcon runs these commands and puts every entry point under lib/<package>, for `ros2 run`;
    # pip does not run them and makes bin/segfloor itself.
    data_files.append(('bin', ['resource/segfloor']))

setup(
    name=PACKAGE,
    version=VERSION,
    description='Occupancy maps for ground robots from a stereo camera alone',
    long_description=(HERE / 'README.md').read_text() if (HERE / 'README.md').exists() else '',
    long_description_content_type='text/markdown',
    license='Apache-2.0',
    maintainer='segfloor_ros maintainers',
    url=os.environ.get('REPOSITORY_URL'),  # set by the workflow that publishes
    classifiers=[
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Topic :: Scientific/Engineering',
    ],
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={
        f'{PACKAGE}.apps.simulation': [
            'scenes/*.yaml',
            'cameras/*.yaml',
            'robots/*.yaml',
            'demo/*',
            'furniture.yaml',
            'world.xml',
            'robot.xml',
        ],
        f'{PACKAGE}.apps.evaluation': ['report.css'],
        f'{PACKAGE}.apps.cli': ['map_editor.html'],
        f'{PACKAGE}.nodes': ['fastdds.xml'],
        f'{PACKAGE}.core.slam.places': ['vocabulary.npy'],
    },
    data_files=data_files,
    python_requires='>=3.10',
    # What the nodes need, then what the command needs. colcon does not install these: on a ROS
    # install rosdep brings the distribution's own packages, which those of pip must not shadow.
    install_requires=[
        'numpy>=1.26',
        'scipy>=1.11',
        'pyyaml>=6.0',
        'opencv-python-headless>=4.6',
        'typer>=0.12',
        'rich>=13',
        'matplotlib>=3.6',
        'rosbags>=0.10',
        'mcap>=1.1',
        'zstandard>=0.19',
        'junitparser>=3',
    ],
    extras_require={
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'evaluate': ['evo>=1.28'],
        'cluster': ['distributed>=2024.5', 'fsspec[http]>=2024.5'],
        'sim': ['mujoco>=3.3'],
        'onnx': ['onnxruntime>=1.17'],
        'view': ["rerun-sdk>=0.41; python_version >= '3.11'"],
        'all': ['segfloor_ros[ros,evaluate,cluster,sim,view]'],
        # colcon takes the tests to be pytest's by this name.
        'test': ['onnx>=1.16', 'pytest', 'pytest-timeout', 'pytest-xdist'],
        'dev': [
            'colcon-common-extensions',
            'mike>=2.1',
            'mkdocs-material>=9.5',
            'mypy',
            'onnx>=1.16',
            'pytest',
            'pytest-timeout',
            'pytest-xdist',
            "rerun-sdk>=0.41; python_version >= '3.11'",
            'ruff',
            "scipy-stubs; python_version >= '3.11'",
            'setuptools<80',
            'types-PyYAML',
        ],
    },
    entry_points={
        'console_scripts': [f'{name} = {PACKAGE}.{where}' for name, where in PROGRAMS.items()]
    },
    zip_safe=True,
)
