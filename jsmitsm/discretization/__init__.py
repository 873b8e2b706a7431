"""A problem on a cloud: supports, coefficients, rows of the global system, their health.

Imports what stands before it but linear: runtime, taylor, particle, cloud and equation.
"""
