"""Random boundary-value problems with known solutions: what they are made of, how they are drawn, how they are judged."""
