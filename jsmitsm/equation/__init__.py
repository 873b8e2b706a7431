"""What the user wrote: the problem, its operators, their record, and what depends on what.

Imports runtime, taylor and cloud.
"""
