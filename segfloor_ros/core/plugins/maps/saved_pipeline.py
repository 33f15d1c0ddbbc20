"""The whole map of a pipeline, saved and loaded."""

from __future__ import annotations

from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.pipeline import Pipeline
from segfloor_ros.core.plugins.maps.saved_slam import load_slam, parts_that_fit, save_slam


def save_pipeline(pipeline: Pipeline) -> MapFile:
    """Return the whole map, once all keyframes are finished. Raises MapError before there is
    one.
    """
    saved = save_slam(pipeline.slam, pipeline.slam.rig.camera)
    saved.parts |= pipeline.keyframe_stages.to_arrays()
    return saved


def load_pipeline(pipeline: Pipeline, saved: MapFile, name: str, localize: bool) -> None:
    """Go on with a saved map, before the first frame. localize: it stays as it is. Raises
    InputError, by the file's name, for one that is damaged or of another camera.
    """
    loaded = load_slam(pipeline.slam, pipeline.slam.rig.camera, saved, name, localize)
    with parts_that_fit(name):
        pipeline.load(saved.parts, loaded)
