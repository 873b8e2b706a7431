"""Whether a function written or read again is the one that was recorded before."""
