"""Suites: many recordings mapped, measured and held against bounds, on one machine or on many.

In: a suite, as a YAML file. Out: a page and JUnit XML with a verdict for each bound.
The way in is `description.read_suite` and `job.outcomes`.
"""
