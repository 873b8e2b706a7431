"""Clouds and solutions in files, of which every process reads and writes its own part."""
