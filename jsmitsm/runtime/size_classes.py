"""Size classes: arrays are padded to a few lengths, so that one compiled program serves clouds of similar size."""

from __future__ import annotations

# Particles per block: larger blocks leave the cache and are several times slower; in one of a power of two, rows of
# the small matrices fall on the same lines of the cache.
BLOCK = 40
# So few particles are always padded to as many.
FEW, _VERY_FEW, _MANY = 2 * BLOCK, 16, 16384
# The lengths of programs that stop after the last particle wanted, up to _MANY: what they are padded by costs its
# memory alone. All but the first hold whole blocks.
_OPEN = (_VERY_FEW, FEW, 13 * BLOCK, 51 * BLOCK, 102 * BLOCK, 204 * BLOCK, 410 * BLOCK)


def padded_size(n: int, steps: int = 8) -> int:
    """The size class of n particles: shapes repeat between clouds of similar size, so that a compiled program serves
    the next cloud too. ``steps`` (a power of two) of them to every doubling: at most one part in as many is wasted."""
    if n <= FEW:
        return FEW if n > _VERY_FEW else _VERY_FEW
    blocks = -(-n // BLOCK)
    step = max(1, (1 << (blocks - 1).bit_length()) // (2 * steps))
    return -(-blocks // step) * step * BLOCK


def open_size(n: int) -> int:
    """The size class of n particles of a program that stops after them."""
    return next((size for size in _OPEN if n <= size), padded_size(n, 4))


def largest_at_hand(n: int) -> int:
    """Up to this size class a program of that kind serves n particles better than one that is yet to be compiled."""
    return max(4 * n, 51 * BLOCK)


def cloud_size(n: int) -> int:
    """The size class of a cloud of n particles, which are only looked up: few programs serve all clouds."""
    bits = max(12, (n - 1).bit_length())
    return 1 << (bits if n > _MANY else bits + bits % 2)
