"""The floor mask: which pixels are floor, which are not, and of which nothing is known.

In: disparity, floor profile, what earlier keyframes saw. Out: 255 floor, 0 not, 127 no evidence.
The way in is `pixel_evidence`; `filling` decides where the image alone cannot.
"""
