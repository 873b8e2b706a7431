"""Steps in time: schemes as data, their stages, their control, what lies between them."""
