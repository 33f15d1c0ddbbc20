"""Scores against ground truth: maps, trajectories, floor masks; and the report of a run.

In: results and truth, as folders or files. Out: figures, pictures, one page of HTML.
The way in is `map_score`, `trajectory`, `floor` and `report`.
"""
