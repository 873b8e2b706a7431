"""Truncated Taylor arithmetic: multi-indices, series, a rule for every primitive, jets of traced functions.

Imports runtime.
"""
