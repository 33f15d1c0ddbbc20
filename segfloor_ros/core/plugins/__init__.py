"""What the core runs without: moving objects, wheels and IMU, the check of the rig, saved maps and
sessions, semantics.

In: what the protocols in `contracts` and `slam.optional` hand over. Out: what they ask for. The way
in is `assembly`, which builds SLAM and the pipeline with everything plugged in.
"""
