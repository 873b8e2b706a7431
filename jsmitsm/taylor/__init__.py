"""Truncated Taylor series: their arithmetic, a rule for every JAX operation, jets of functions.

Imports runtime.
"""
