"""Every number of the tables of results: measured again on a CPU, or listed with the command that measures it.

claims (the numbers, their jobs and commands) ─► __main__ (runs jobs, compares, lists)
"""
