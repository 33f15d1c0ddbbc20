"""Rendered worlds with exact ground truth, and a robot that drives in them.

In: a scene, as a YAML file. Out: a recording with truth, or the topics of a simulated robot.
The way in is `simulation.Simulation` and `simulated_robot`.
"""
