"""What the user wrote: the problem, its operators and conditions, traced and linearised.

Imports runtime, taylor and cloud.
"""
