"""The choice of a kernel by gradients.

Imports solution and what stands before it.
"""
