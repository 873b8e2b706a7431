"""Clouds made anew on the way of an evolution, where its error is: what is asked, the parts of time, what comes out."""
