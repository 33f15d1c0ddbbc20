"""What people run: the command `segfloor`, readers and writers of recordings, calibration, scores
and reports, suites, simulation and benchmark. Imports the core and the nodes; neither imports it.
"""
