"""A problem with several regions on their cloud: each region discretised as ever, and the copies that bind them."""
