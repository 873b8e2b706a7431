"""What several processes do with the pencil of a problem that they share: time, and modes."""
