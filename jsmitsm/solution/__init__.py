"""From a problem to an answer: solve, Newton's method, error estimate, flags.

Imports everything before it.
"""
