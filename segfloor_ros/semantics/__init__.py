"""What a network sees in an image: masks of what moves, labels of points and cells.

`network` runs it, `outputs` reads what it returns, `frames` runs it beside a drive, `label_map`
keeps the likeliest class of points and cells.
"""
