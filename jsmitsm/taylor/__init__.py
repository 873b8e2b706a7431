"""Truncated Taylor series: multi-indices, arithmetic, a rule for every JAX operation, jets of functions.

Imports runtime.
"""
