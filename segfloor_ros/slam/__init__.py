"""Feature-based stereo SLAM: features, tracking, keyframes, sparse map, bundle adjustment."""
