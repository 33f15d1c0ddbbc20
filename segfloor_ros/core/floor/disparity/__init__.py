"""Disparity and what is read from it: u/v-disparity, floor profile.

In: a rectified pair, or measured depth. Out: disparity (px), the disparity of the floor per row.
The way in is `matching.DisparityMatcher`. Papers: Hirschmueller, Semi-Global Matching (2008); Hu
and Uchimura, UV-disparity (2005); Wedel et al., B-Spline Modeling of Road Surfaces (2009).
"""
