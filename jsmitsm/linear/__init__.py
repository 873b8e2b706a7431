"""The global linear solve: its derivative rule, backends, kept factors, condition numbers.

Imports runtime.
"""
