"""The global system solved: backends, kept factors, and the derivative of a linear solve.

Imports runtime.
"""
