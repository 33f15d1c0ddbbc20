"""Places: which keyframe shows the same place, and what follows from it.

In: a view, by its words. Out: a loop is closed, a lost camera found again, a submap merged.
The way in is `place_recognition.PlaceRecognition`; `loops` and `loop_closing` use it.
Papers: Galvez-Lopez and Tardos, Bags of Binary Words (2012); Nister and Stewenius (2006).
"""
