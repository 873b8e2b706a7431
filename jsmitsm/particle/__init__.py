"""One particle, written once: kernels, the recursion, moment systems, and the vmap over them.

Imports runtime and taylor.
"""
