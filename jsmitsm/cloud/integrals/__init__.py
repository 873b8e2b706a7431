"""Ways from facets to the boundary, and where its edges lie over them."""
