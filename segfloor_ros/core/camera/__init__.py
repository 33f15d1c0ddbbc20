"""The stereo camera: its model, calibration, images and the recordings they come from.

In: folders, bags, videos, devices, depth images. Out: stamped stereo frames of a known camera.
The way in is `sources.open_source`; `calibration` measures and reads lenses and rectifies.
"""
