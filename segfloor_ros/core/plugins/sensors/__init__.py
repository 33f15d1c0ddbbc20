"""Sensors beside the camera: wheel odometry, gyroscope and accelerometer.

In: stamped messages. Out: the camera's motion between two frames with its covariance, and the links
between keyframes that a bundle adjustment takes.
The way in is `body_motion.BodyMotion`. Paper: Forster et al., On-Manifold Preintegration (2017).
"""
