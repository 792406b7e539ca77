"""The inverse of many models compiled: each kind of hysteresis in a file of its own.

They need numba, which is loaded when many models are read backwards, not before. What they are
given is the same as for a step of the closed loop (:mod:`bwbayes.model.inverse.steps`).
"""
