"""A problem on a cloud: supports, coefficients, the rows of the global system and their health.

Imports what stands before it but linear: runtime, taylor, particle, cloud and equation.
"""
