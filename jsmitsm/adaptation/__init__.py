"""A tolerance in, an answer out: particles and order chosen by the estimated error.

It makes clouds, solves on them and reads the solution's estimate: everything from runtime to solution, and nothing of
show or tuning.
"""
