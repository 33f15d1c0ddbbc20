"""The labelled sparse cloud: which SLAM points are floor and which are obstacles."""
