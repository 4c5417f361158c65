"""The Unitree B2: learning to walk, and navigation learnt for its legs."""
