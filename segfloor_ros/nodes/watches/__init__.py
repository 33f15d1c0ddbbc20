"""What finds over time that something around a node is wrong, and says it with the remedy.

In: what a node notes of images, frames and faults. Out: diagnoses of its reporter. A node works
without: it knows the protocols of `slam_camera` and `shared.transforms` alone, and plugs these in.
"""
