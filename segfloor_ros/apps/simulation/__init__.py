"""Rendered worlds with exact ground truth."""
