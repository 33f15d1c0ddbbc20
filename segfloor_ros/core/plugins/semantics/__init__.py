"""What a network sees in an image: masks of what moves, labels of points and cells.

`network` runs it, also beside a drive, `outputs` reads what it returns, `label_map` keeps the
likeliest class of points and cells.
"""
