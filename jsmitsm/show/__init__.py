"""Pictures and files.

Imports solution and what stands before it.
"""
