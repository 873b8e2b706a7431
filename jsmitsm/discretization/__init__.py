"""A problem on a cloud: supports, coefficients, rows, their health, and the two global forms.

Imports what stands before it but linear: runtime, taylor, particle, cloud and equation.
"""
