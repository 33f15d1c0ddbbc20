"""What the core runs without: moving objects, wheels and IMU, the check of the rig, saved maps,
semantics.
"""
