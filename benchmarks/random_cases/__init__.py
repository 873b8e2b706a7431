"""Random boundary-value problems with known solutions: their parts, how they are drawn, how they are judged."""
