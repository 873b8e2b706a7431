"""The kernel that suits a problem, found by gradients.

Imports solution and what stands before it.
"""
