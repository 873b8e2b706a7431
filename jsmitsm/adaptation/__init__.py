"""A tolerance in, an answer out: particles and order chosen by the estimated error.

Imports solution and what stands before it.
"""
