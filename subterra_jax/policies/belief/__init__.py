"""A histogram filter on a known map, whose sensor is learnt."""
