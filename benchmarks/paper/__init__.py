"""The paper's figures at print size, each with its data beside it.

steps (survey, scene, training) ─► material ─► figures, learning ─► sheet (PDF, PNG, CSV, JSON)
"""
