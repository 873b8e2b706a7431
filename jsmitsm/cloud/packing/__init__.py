"""What filling a domain is made of: cells, lattices, repulsion."""
