"""Looks at a finished solve: what it says of itself at the particles, and what these do not see."""
