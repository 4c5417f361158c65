"""The benchmark as it behaves, against the figures that its design states.

Every number that is expected here is written down a second time and read from no code: from docs/tasks.md and the task
design behind it. Robots are drawn and driven by the thousand without scans, so that a figure that is off by half lies
many standard errors away; comparisons allow four. Analytic answers are exact but for float32.
"""
