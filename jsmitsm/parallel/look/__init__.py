"""What several processes say of a solution that they share."""
