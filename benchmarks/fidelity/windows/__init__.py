"""Worst windows: what a mean over the whole tunnel hides.

beams ─► deviation ─┐
bore  ─► relief    ─┼─► judge (values by window, limits.json) ─► verdict, report
rails ─► track     ─┘
"""
