"""What must be noticed and what must not: 36 negative controls, 7 invariances, and the runner of both."""
