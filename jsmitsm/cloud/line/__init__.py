"""Particles along a line: intervals, and paths that follow a spacing however steeply it is graded."""
