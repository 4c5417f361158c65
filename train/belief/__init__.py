"""Learning what a scan says of a place on a known map: the sensor of a histogram filter.

a stretch driven ─► lesson: the true way beside others that it might have been ─► cross entropy of the true one
"""
