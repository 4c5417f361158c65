"""Every number of the README that a CPU can measure, measured again and held against what the README says."""
