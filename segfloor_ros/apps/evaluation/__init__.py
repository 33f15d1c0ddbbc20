"""Scores against ground truth: maps, trajectories, floor masks."""
