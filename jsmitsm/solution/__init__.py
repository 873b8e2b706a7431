"""From a problem to an answer: solve, Newton, error estimate, flags, factorize.

Imports everything before it.
"""
