"""What JAX and the machine need: programs kept whole, threads, progress, errors.

Imports nothing of the package.
"""
