"""A particle filter on a known map: as a localiser, and to find out where one was put down."""
