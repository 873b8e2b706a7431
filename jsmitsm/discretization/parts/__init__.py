"""A cloud that several processes share."""
