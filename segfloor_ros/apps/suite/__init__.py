"""Suites: many recordings mapped, measured and held against bounds, on one machine or on many."""
