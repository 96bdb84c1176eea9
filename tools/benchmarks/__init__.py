"""The parts of the benchmark: optics, scenes, motion, sensor, cases, methods, scores, report.

Nothing here is shipped with the controller, and nothing of the controller's own simulator is used: the pictures are
shared, the lens, the sensor model and the motion are the paper's, built again from its text. Everything follows from a
seed.
"""
