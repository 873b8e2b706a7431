"""Several regions in time: the parts of each region's equation, put together."""
